"""Which phrases name a part or a body for one prior: its own, their plurals and singulars, and those of the word table.

Phrases are looked up with their blanks taken out, so that "top hat", "tophat" and "skate board" need no rule.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from fd_mitsuba.guidance.vocabulary import Vocabulary, bare
from fd_mitsuba.guidance.word_table import WordTable

LONGEST = 5
"""Words of a phrase that is looked up."""
Kind = Literal["part", "body", "whole", "attribute"]
_IRREGULAR = {"goose": "geese", "mouse": "mice", "wolf": "wolves", "calf": "calves", "elf": "elves", "man": "men"}
_IRREGULAR |= {"woman": "women", "child": "children", "fish": "fishes", "person": "people", "dwarf": "dwarves"}


@dataclass(frozen=True)
class Entry:
    """What a phrase stands for.

    Attributes:
        kind: `whole` names a body together with its part; `attribute` is an adjective that gives a body a part.
        name: of the part or the body; of a whole and of an attribute, the part's.
        known: whether the prior knows that part or body.
        phrase: what to tell the prior where it was trained with this very phrase; None: the usual phrase of `name`.
    """

    kind: Kind
    name: str
    known: bool = True
    phrase: str | None = None


def lexicon(vocabulary: Vocabulary, table: WordTable) -> dict[str, Entry]:
    """Phrase without blanks -> what it means. A prior's own phrases come before the table's, exact ones before others.

    A part or body of the table that the prior does not know has `known` False, or its stand-in's name where it has one.
    """
    found: dict[str, Entry] = {}

    def add(phrases: Iterable[tuple[str, Entry]]) -> None:
        for phrase, entry in phrases:
            found.setdefault(phrase.replace(" ", "").replace("'s", ""), entry)

    own = list(_own(vocabulary))
    add(own)
    add((form, Entry(e.kind, e.name)) for phrase, e in own for form in _inflected(phrase, table))
    others = list(_others(vocabulary, table))
    add(others)
    add((form, entry) for phrase, entry in others for form in _inflected(phrase, table))
    return found


def _own(vocabulary: Vocabulary) -> Iterator[tuple[str, Entry]]:
    for name, phrases in vocabulary.parts.items():
        for phrase in phrases:
            yield bare(phrase), Entry("part", name, True, bare(phrase))
    for phrase, part in vocabulary.wholes.items():
        yield phrase, Entry("whole", part, True, phrase)
    for name, phrases in vocabulary.bodies.items():
        for phrase in phrases:
            yield phrase, Entry("body", name, True, phrase)


def _others(vocabulary: Vocabulary, table: WordTable) -> Iterator[tuple[str, Entry]]:
    for name, words in table.parts.items():
        entry = _part(name, vocabulary, table)
        yield from ((word, entry) for word in (name, *words))
    for word, part in table.attributes.items():
        entry = _part(part, vocabulary, table)
        yield word, Entry("attribute", entry.name, entry.known)
    for name, words in table.bodies.items():
        entry = _body(name, vocabulary, table)
        yield from ((word, entry) for word in (name, *words))


def _part(name: str, vocabulary: Vocabulary, table: WordTable) -> Entry:
    if name not in vocabulary.parts and table.part_stand_ins.get(name) in vocabulary.parts:
        name = table.part_stand_ins[name]
    return Entry("part", name, name in vocabulary.parts)


def _body(name: str, vocabulary: Vocabulary, table: WordTable) -> Entry:
    for body in (name, *table.body_stand_ins.get(name, ())):
        if body in vocabulary.bodies:
            return Entry("body", body)
    return Entry("body", name, False)


def _inflected(phrase: str, table: WordTable) -> list[str]:
    """Plural and singular of the phrase by its last word."""
    rest, _, word = phrase.rpartition(" ")
    if word in table.plural_only or "with" in rest.split() or "on" in rest.split():
        return []
    forms = [_plural(word)]
    if word.endswith("s") and not word.endswith("ss"):
        forms.append(word[:-1])
    return [f"{rest} {form}".strip() for form in forms]


def _plural(word: str) -> str:
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if word.endswith("y") and word[-2:-1] not in "aeiou":
        return f"{word[:-1]}ies"
    return f"{word}es" if word.endswith(("s", "x", "ch", "sh")) else f"{word}s"
