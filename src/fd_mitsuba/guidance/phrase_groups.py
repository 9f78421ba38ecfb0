"""Where a prompt names parts and bodies, and which words belong to each: "two big golden | wings | made of gold"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from fd_mitsuba.guidance.lexicon import LONGEST, Entry
from fd_mitsuba.guidance.prompt_tokens import Token
from fd_mitsuba.guidance.vocabulary import Vocabulary, bare
from fd_mitsuba.guidance.word_table import WordTable

_DETERMINERS = frozenset("a an the one two three four some any my your his her its their our another this that".split())
_COUNTED = ("pair", "row")


@dataclass(frozen=True)
class Group:
    """A phrase that names a part or a body, with the words that belong to it.

    Attributes:
        first, behind: its tokens, without the words before and after it.
        entry: what it names.
        modifiers: positions of the words before it that belong to it, in order.
        within: numbers of other phrases among these: "fox tail" has a fox in it.
        determiner: "", "a", "the", "two", "a pair of", ...
        made_of: the words of a colour or material behind it: "made of gold", "of blue plastic", "in red".
        begin: first token of it all; `end`: behind its last.
        taken_away: whether the word itself says that there is none: "wingless".
    """

    first: int
    behind: int
    entry: Entry
    modifiers: tuple[int, ...] = ()
    within: tuple[int, ...] = ()
    determiner: str = ""
    made_of: tuple[str, ...] = ()
    begin: int = 0
    end: int = 0
    taken_away: bool = False


@dataclass(frozen=True)
class _Span:
    first: int
    behind: int
    entry: Entry
    taken_away: bool = field(default=False)


def find_groups(
    tokens: Sequence[Token], entries: dict[str, Entry], vocabulary: Vocabulary, table: WordTable
) -> list[Group]:
    """All phrases of the lexicon in a prompt, in order, longest first, with what belongs to them."""
    spans = _spans(tokens, entries, table)
    owner = {place: number for number, span in enumerate(spans) for place in range(span.first, span.behind)}
    groups = []
    for span in spans:
        group = _with_words_before(span, tokens, spans, owner, table)
        group = _with_words_behind(group, tokens, owner, table)
        groups.append(_with_inner_words(group, tokens, vocabulary))
    return groups


def _spans(tokens: Sequence[Token], entries: dict[str, Entry], table: WordTable) -> list[_Span]:
    spans, place = [], 0
    while place < len(tokens):
        for length in range(min(LONGEST, len(tokens) - place), 0, -1):
            words = tokens[place : place + length]
            entry = None if any(word.is_stop for word in words) else entries.get("".join(word.text for word in words))
            if length == 1 and words[0].text in table.function:  # "does" are no deer
                entry = None
            if entry is not None:
                spans.append(_Span(place, place + length, entry))
                break
        else:
            length = 1
            if (entry := _taken_away(tokens[place].text, entries)) is not None:
                spans.append(_Span(place, place + 1, entry, True))
        place += length
    return spans


def _taken_away(word: str, entries: dict[str, Entry]) -> Entry | None:
    """What "wingless" or "unwinged" says is not there."""
    stems = [word.removesuffix("less")] if word.endswith("less") else []
    stems += [word.removeprefix("un")] if word.startswith("un") else []
    found = (entries.get(form) for stem in stems for form in (stem, f"{stem}s"))
    return next((entry for entry in found if entry is not None and entry.kind != "body"), None)


def _with_words_before(
    span: _Span, tokens: Sequence[Token], spans: list[_Span], owner: dict[int, int], table: WordTable
) -> Group:
    modifiers: list[int] = []
    within: list[int] = []
    determiner, place = "", span.first - 1
    while place >= 0:
        text = tokens[place].text
        if place in owner:
            other = owner[place]
            if spans[other].taken_away:
                break
            within.insert(0, other)
            place = spans[other].first - 1
            continue
        if text in _DETERMINERS:
            determiner = text
            place -= 1
            break
        counted = tokens[place - 1].text if place else ""
        if text == "of" and counted in _COUNTED and place > 1 and tokens[place - 2].text == "a":
            determiner = f"a {counted} of"
            place -= 3
            break
        before = tokens[place - 1].text if place else ""
        listed = text == "," and modifiers and table.is_style(before)
        if not listed and (text in ",." or text in table.function or text in table.negation_words):
            break
        if not listed:
            modifiers.insert(0, place)
        place -= 1
    return Group(
        span.first, span.behind, span.entry, tuple(modifiers), tuple(within), determiner, (), place + 1, span.behind,
        span.taken_away,
    )  # fmt: skip


def _with_words_behind(group: Group, tokens: Sequence[Token], owner: dict[int, int], table: WordTable) -> Group:
    for link in (["made", "of"], ["made", "from"], ["out", "of"], ["of"], ["in"]):
        place = first = group.behind + len(link)
        if [token.text for token in tokens[group.behind : first]] != link:
            continue
        while place < len(tokens) and place not in owner and table.is_style(tokens[place].text):
            place += 1
        following = tokens[place] if place < len(tokens) else Token(".")
        # "a cat in red glasses": the colour is of what follows it.
        if place > first and (following.is_stop or following.text in table.function):
            return replace(group, made_of=tuple(token.text for token in tokens[first:place]), end=place)
    return group


def _with_inner_words(group: Group, tokens: Sequence[Token], vocabulary: Vocabulary) -> Group:
    """Where a phrase was broken up ("a pointed red hat") the part is that of the whole phrase."""
    if group.entry.kind != "part" or group.entry.phrase is not None:
        return group
    head, before = tokens[group.behind - 1].text, {tokens[place].text for place in group.modifiers}
    choices = [
        (len(words), name)
        for name, phrases in vocabulary.parts.items()
        for phrase in phrases
        if (words := bare(phrase).split())[-1] == head and len(words) > 1 and set(words[:-1]) <= before
    ]
    if not choices:
        return group
    name = max(choices)[1]
    return replace(group, entry=Entry("part", name, True, head))
