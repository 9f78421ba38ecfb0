"""The table of what people write for what a prior knows: `words.toml`, beside this file."""

from __future__ import annotations

import tomllib
from functools import cache, cached_property
from pathlib import Path

from pydantic import BaseModel, ConfigDict

_FILE = Path(__file__).with_name("words.toml")


class Negation(BaseModel):
    """Words that take away what they stand by."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    before: frozenset[str]
    """What follows is not wanted."""
    swaps: frozenset[str]
    """The same, up to "with", "for" or "by"."""
    phrases: tuple[str, ...]
    """As `before`, of several words."""
    severing: frozenset[str]
    """Verbs that do it together with "off" or "away"."""
    after: frozenset[str]
    """What stands directly before is not wanted."""
    backdrop: frozenset[str]
    """Nouns that such words are often about and that are no parts."""

    @cached_property
    def silent(self) -> frozenset[str]:
        """All words that say no more than the negation."""
        of_phrases = frozenset(word for phrase in self.phrases for word in phrase.split())
        return self.before | self.swaps | self.severing | self.after | of_phrases


class WordTable(BaseModel):
    """`words.toml`; all words in lower case, keys are canonical names. The file says what each table is for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    neutral: tuple[str, ...]
    worn: frozenset[str]
    ridden: frozenset[str]
    plural_only: frozenset[str]
    parts: dict[str, tuple[str, ...]]
    part_stand_ins: dict[str, str]
    attributes: dict[str, str]
    bodies: dict[str, tuple[str, ...]]
    body_stand_ins: dict[str, tuple[str, ...]]
    whole_bodies: dict[str, str]
    adjectives: frozenset[str]
    colours: dict[str, tuple[str, ...]]
    materials: dict[str, tuple[str, ...]]
    function: frozenset[str]
    places: frozenset[str]
    negation: Negation

    @cached_property
    def negation_words(self) -> frozenset[str]:
        """Every word that starts a negation by itself."""
        return self.negation.before | self.negation.swaps

    @cached_property
    def _styles(self) -> frozenset[str]:
        tables = (*self.colours.items(), *self.materials.items())
        return frozenset(word for name, others in tables for word in (name, *others))

    def is_style(self, word: str) -> bool:
        """Whether a word says a colour or a material."""
        return word in self._styles

    def style_of(self, word: str, known: frozenset[str]) -> tuple[str, str] | None:
        """(the word that a prior knows, the name of the colour or material) for a word; None if it is neither.

        Args:
            known: the prior's words. The word itself is kept where the prior knows it.
        """
        for table in (self.colours, self.materials):
            for name, others in table.items():
                adjective = name if table is self.colours else others[0]
                if word in (name, *others):
                    chosen = word if word in known else adjective
                    return (chosen, name) if chosen in known else None
        return None


@cache
def word_table() -> WordTable:
    """The table as it is shipped."""
    with open(_FILE, "rb") as file:
        data = tomllib.load(file)
    for group in ("adjectives", "function", "places"):
        words = data[group]["words"]
        data[group] = words.split() if isinstance(words, str) else words
    for name in ("before", "swaps", "severing", "after", "backdrop"):
        data["negation"][name] = data["negation"][name].split()
    return WordTable.model_validate(data)
