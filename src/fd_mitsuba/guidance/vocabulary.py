"""The words that a guidance model was trained with, where they can be listed."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

WITHOUT = "without"
_ARTICLES = ("a pair of ", "a row of ", "a ", "an ", "the ", "one ", "two ")


class Vocabulary(BaseModel):
    """The words that a model was trained with; stands in the model's `fd_mitsuba.json`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bodies: dict[str, tuple[str, ...]]
    """Phrases for every kind of body, the usual one first."""
    parts: dict[str, tuple[str, ...]]
    """Phrases for every kind of part, with or without an article."""
    wholes: dict[str, str] = {}
    """Words that name a body with its part, and that part: "unicorn" -> "horn"."""
    words: tuple[str, ...] = ()
    """All other words: adjectives, colours, materials, links."""

    @property
    def takes_off(self) -> bool:
        """Whether the model has learned captions of removal, "a mug without a handle"."""
        return WITHOUT in self.words

    def known_words(self) -> frozenset[str]:
        """Every single word of the phrases and of `words`."""
        phrases = (*self.bodies.values(), *self.parts.values(), tuple(self.wholes), self.words)
        return frozenset(word for group in phrases for phrase in group for word in phrase.split())


def bare(phrase: str) -> str:
    """The phrase without its article or number: "a pair of wings" -> "wings"."""
    return phrase.removeprefix(article_of(phrase))


def article_of(phrase: str) -> str:
    """Article or number at the phrase's front with the blank behind it; "" if there is none."""
    return next((article for article in _ARTICLES if phrase.startswith(article)), "")
