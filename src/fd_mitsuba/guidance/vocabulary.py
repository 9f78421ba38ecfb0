"""What a prompt asks of a model that knows a list of words: the parts and bodies it names, the words it ignores."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict

_LINKS = frozenset("a an the with that has wearing on standing riding and of its made two one pair row".split())
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


@dataclass(frozen=True)
class PromptReading:
    """Attributes:
    parts: names of the known parts that the prompt asks for; empty if there is none.
    bodies: names of the known bodies in it.
    ignored: its words that the model never saw.
    nearest: known part phrases that are spelt most like the prompt's words, best first.
    """

    parts: tuple[str, ...]
    bodies: tuple[str, ...]
    ignored: tuple[str, ...]
    nearest: tuple[str, ...]


def read_prompt(prompt: str, vocabulary: Vocabulary) -> PromptReading:
    """What of `prompt` the vocabulary covers. Case and punctuation do not count."""
    words = re.findall(r"[^\W\d_]+", prompt.lower())
    part_phrases = {_bare(phrase): name for name, phrases in vocabulary.parts.items() for phrase in phrases}
    part_phrases |= vocabulary.wholes
    body_phrases = {phrase: name for name, phrases in vocabulary.bodies.items() for phrase in phrases}
    known = {word for phrase in (*part_phrases, *body_phrases, *vocabulary.words) for word in phrase.split()}
    known |= {word for phrases in vocabulary.parts.values() for phrase in phrases for word in phrase.split()}
    parts = tuple(dict.fromkeys(name for phrase, name in part_phrases.items() if _occurs(phrase, words)))
    bodies = tuple(dict.fromkeys(name for phrase, name in body_phrases.items() if _occurs(phrase, words)))
    ignored = tuple(dict.fromkeys(word for word in words if word not in known))
    return PromptReading(parts, bodies, ignored, _nearest(words, part_phrases))


def _bare(phrase: str) -> str:
    for article in _ARTICLES:
        if phrase.startswith(article):
            return phrase.removeprefix(article)
    return phrase


def _occurs(phrase: str, words: list[str]) -> bool:
    wanted = phrase.split()
    return any(words[i : i + len(wanted)] == wanted for i in range(len(words) - len(wanted) + 1))


def _nearest(words: list[str], phrases: dict[str, str]) -> tuple[str, ...]:
    """Up to four part phrases that share a word with the prompt or are spelt like one of its words."""
    asked = [word for word in words if word not in _LINKS]
    scores = {
        phrase: max((difflib.SequenceMatcher(None, a, b).ratio() for a in asked for b in _content(phrase)), default=0.0)
        for phrase in phrases
    }
    near = [phrase for phrase in phrases if scores[phrase] > 0.72]
    return tuple(sorted(near, key=lambda phrase: (-scores[phrase], len(phrase), phrase))[:4])


def _content(phrase: str) -> list[str]:
    return [word for word in phrase.split() if word not in _LINKS]
