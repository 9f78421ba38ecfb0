"""What a prompt in people's words asks of a model that knows a list of words, and the caption that says so to it.

The caption has one of the forms of the model's training: "a cat wearing a golden crown". Words that the model was not
trained with are not in it: they would fall apart into known letters, and steer.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field

from fd_mitsuba.guidance.caption_writer import CaptionWriter
from fd_mitsuba.guidance.lexicon import lexicon
from fd_mitsuba.guidance.negation import negated_words, says_no_to_a_no
from fd_mitsuba.guidance.phrase_groups import Group, find_groups
from fd_mitsuba.guidance.prompt_subjects import find_subjects
from fd_mitsuba.guidance.prompt_tokens import Token, tokens_of
from fd_mitsuba.guidance.vocabulary import Vocabulary, bare
from fd_mitsuba.guidance.word_table import WordTable, word_table

_ALIKE = 0.72
"""A phrase is named as near to a prompt if one of its words is so much like one of the prompt's."""


@dataclass(frozen=True)
class PromptReading:
    """Attributes:
    parts: names of the known parts that the prompt asks for; empty if there is none.
    bodies: name of the known body that they go on; empty where neither the prompt nor the base prompt names one.
    caption: what the model is told; "" without a part. Where the prompt only takes parts off, and the model has learned
        that, "a mug without a handle".
    styles: names of the parts' colours and materials.
    removed: parts that the prompt wants off, or not to be there.
    unknown_parts: parts that it asks for and that the model does not know.
    taken_for: the prompt's own word -> the part or body that it was taken for.
    ignored: its words that the model is not told.
    nearest: known part phrases that are spelt most like the prompt's words, best first.
    doubtful: whether it says no to a no, or both wants and does not want the same part.
    phrases: of each of `parts`, the prompt's own words for it: "a golden crown".
    """

    parts: tuple[str, ...]
    bodies: tuple[str, ...]
    caption: str
    styles: tuple[str, ...]
    removed: tuple[str, ...]
    unknown_parts: tuple[str, ...]
    taken_for: dict[str, str]
    ignored: tuple[str, ...]
    nearest: tuple[str, ...]
    doubtful: bool = False
    phrases: dict[str, str] = field(default_factory=dict)

    def summary(self) -> str:
        """One line: "part: pointed hat; body: rabbit; ignored: cuddly"."""

        def named(name: str) -> str:
            said = [word for word, meant in self.taken_for.items() if meant == name]
            return f"{name} (for {', '.join(map(repr, said))})" if said else name

        parts = [named(name) for name in self.parts] or ["none that is known"]
        only_off = bool(self.caption) and not self.parts
        listed = {
            "taken off": [named(name) for name in self.removed] if only_off else [],
            "part" if len(parts) == 1 else "parts": [] if only_off else parts,
            "look": self.styles,
            "body": [named(name) for name in self.bodies] or ["none that is known"],
            "not wanted": [] if only_off else self.removed,
            "not known": self.unknown_parts,
            "ignored": self.ignored,
        }
        return "; ".join(f"{title}: {', '.join(names)}" for title, names in listed.items() if names)


def read_prompt(prompt: str, vocabulary: Vocabulary, base_prompt: str = "") -> PromptReading:
    """What of `prompt` the vocabulary covers, in whatever order and by whatever synonym it is said.

    "put a crown on the dragon" -> "a dragon with a crown", or "a dog with a crown" where dragons are unknown. Case,
    punctuation, articles, plurals, hyphens and possessives do not count. A part under a negation is not among `parts`.

    Args:
        base_prompt: says the body where the prompt itself names none.
    """
    table = word_table()
    tokens = tokens_of(prompt)
    groups = find_groups(tokens, lexicon(vocabulary, table), vocabulary, table)
    named = [group for group in groups if group.entry.kind != "body"]
    places = [(group.first, group.behind) for group in named]
    negated = negated_words(tokens, places, table.negation)
    removed = {group.entry.name for group in named if group.taken_away or group.first in negated}
    subjects = find_subjects(tokens, groups, removed, table)
    wanted = [group for group in subjects.parts if group.entry.known]
    body = subjects.body_name
    if body is None and subjects.body is None:
        body = _body_within(wanted, vocabulary)
        if body is None and base_prompt:
            body = next(iter(read_prompt(base_prompt, vocabulary).bodies), None)
    writer = CaptionWriter(vocabulary, table, tokens, negated)
    whole = subjects.body is not None and subjects.body.entry.kind == "whole"
    told = [group for group in wanted if group is not subjects.body]
    not_wanted = [group for group in named if group.entry.name in removed]
    off = list({group.entry.name: group for group in reversed(not_wanted) if group.entry.known}.values())[::-1]
    caption = writer.caption(subjects.body, body, told) if wanted else ""
    if not wanted and off and vocabulary.takes_off:
        caption = writer.removal(subjects.body, body, off)
    known_body = [group for group in (subjects.body,) if group is not None and group.entry.known]
    return PromptReading(
        parts=tuple(group.entry.name for group in wanted),
        bodies=() if body is None else (body,),
        caption=caption,
        styles=tuple(dict.fromkeys(writer.styles)),
        removed=tuple(sorted(removed)),
        unknown_parts=tuple(group.entry.name for group in subjects.parts if not group.entry.known),
        taken_for={}
        if whole
        else _taken_for(
            tokens, [*subjects.parts, *(group for group in off if not (wanted or group.taken_away)), subjects.body]
        ),
        ignored=_ignored(tokens, [*subjects.parts, *known_body, *not_wanted], writer.used, table),
        nearest=_nearest([token.text for token in tokens], vocabulary, table),
        doubtful=says_no_to_a_no(tokens, places, table.negation)
        or any(
            group.entry.kind == "part"
            and group.entry.name in removed
            and not (group.taken_away or group.first in negated)
            for group in named
        ),
        phrases={group.entry.name: _own_words(group, tokens, vocabulary) for group in wanted},
    )


def known_text(text: str, vocabulary: Vocabulary) -> str:
    """The text without the words that the vocabulary lacks: for prompts that say what to keep away from."""
    known = vocabulary.known_words()
    return " ".join(token.text for token in tokens_of(text) if token.text in known)


def _own_words(group: Group, tokens: Sequence[Token], vocabulary: Vocabulary) -> str:
    """What the prompt says of a part, what it is made of included; a phrase of the model's for "winged"."""
    if group.entry.kind != "part":
        return vocabulary.parts[group.entry.name][0]
    said = [token for token in tokens[group.begin : group.end] if not token.is_stop]
    return " ".join(token.text + "'s" * token.owner for token in said)


def _body_within(parts: Sequence[Group], vocabulary: Vocabulary) -> str | None:
    """The body that a part's own phrase holds: "give the bull horns" is read as "bull horns"."""
    words = [word for group in parts for word in (group.entry.phrase or "").split()[:-1]]
    return next((name for name, nouns in vocabulary.bodies.items() for word in words if word in nouns), None)


def _taken_for(tokens: Sequence[Token], groups: Sequence[Group | None]) -> dict[str, str]:
    found = {}
    for group in groups:
        if group is None:
            continue
        said = " ".join(token.text for token in tokens[group.first : group.behind])
        name = group.entry.name
        if group.entry.known and group.entry.phrase is None and said != name:
            found[said] = name
    return found


def _ignored(tokens: Sequence[Token], understood: Sequence[Group], used: set[int], table: WordTable) -> tuple[str, ...]:
    explained = {place for group in understood for place in range(group.first, group.behind)} | used
    silent = table.function | table.places | table.negation.silent
    left = [token.text for place, token in enumerate(tokens) if place not in explained and not token.is_stop]
    return tuple(dict.fromkeys(word for word in left if word not in silent))


def _nearest(words: Sequence[str], vocabulary: Vocabulary, table: WordTable) -> tuple[str, ...]:
    """Up to four part phrases that share a word with the prompt or are spelt like one of its words."""
    phrases = dict.fromkeys(bare(phrase) for phrases in vocabulary.parts.values() for phrase in phrases)
    asked = [word for word in dict.fromkeys(words) if word not in table.function and word[0].isalnum()]
    scores = {
        phrase: max((_likeness(asked, word) for word in phrase.split() if word not in table.function), default=0.0)
        for phrase in (*phrases, *vocabulary.wholes)
    }
    near = [phrase for phrase in scores if scores[phrase] > _ALIKE]
    return tuple(sorted(near, key=lambda phrase: (-scores[phrase], len(phrase), phrase))[:4])


def _likeness(asked: Sequence[str], word: str) -> float:
    """How much of a word's spelling the nearest of the words asked for has; anything up to `_ALIKE` if none is near."""
    best, matcher = _ALIKE, difflib.SequenceMatcher(None, "", word)
    for other in asked:
        matcher.set_seq1(other)
        # Bounds, several times as fast as the ratio itself.
        if matcher.real_quick_ratio() > best and matcher.quick_ratio() > best:
            best = max(best, matcher.ratio())
    return best
