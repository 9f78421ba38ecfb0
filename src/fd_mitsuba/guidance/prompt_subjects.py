"""Which of a prompt's phrases is the body and which are the parts that it shall get."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from fd_mitsuba.guidance.phrase_groups import Group
from fd_mitsuba.guidance.prompt_tokens import Token
from fd_mitsuba.guidance.word_table import WordTable

_HAS = frozenset("with has have having wearing wears wear sporting".split())
_ONTO = frozenset("on onto upon to for".split())
_OWNERS = frozenset("its his her their my your our".split())


@dataclass(frozen=True)
class Subjects:
    """Attributes:
    body: the phrase that says the body; None if none does.
    body_name: its canonical name; None as well where nobody knows such a body.
    parts: the phrases of the parts that are wanted, one a part, known to the model or not.
    """

    body: Group | None
    body_name: str | None
    parts: tuple[Group, ...]


def find_subjects(
    tokens: Sequence[Token], groups: Sequence[Group], removed: Collection[str], table: WordTable
) -> Subjects:
    """The body and the wanted parts among a prompt's phrases.

    Args:
        removed: names of parts that are not wanted.
    """
    places = [group for group in groups if _is_place(group, groups, tokens, table)]
    holders = {inner: group for group in groups if group not in places for inner in group.within}

    def inside(number: int, *kinds: str) -> bool:
        return number in holders and holders[number].entry.kind in kinds

    numbered = list(enumerate(groups))
    explicit = [
        group
        for number, group in numbered
        if group.entry.kind == "part" and not inside(number, "part") and not _is_of_a_part(number, groups, tokens)
    ]
    named = [group for number, group in numbered if group.entry.kind == "body" and not inside(number, "part", "body")]
    lent = [group for number, group in numbered if group.entry.kind == "body" and inside(number, "part")]
    named = [group for group in named if group not in places]
    wholes = [group for group in groups if group.entry.kind == "whole"]
    wanted = [group for group in explicit if group.entry.name not in removed]

    adjuncts = [groups[n] for n in holders if groups[n].entry.kind == "part" and inside(n, "body", "whole")]
    if len(wanted) > len(adjuncts):  # "a flower vase with a handle"
        wanted = [group for group in wanted if group not in adjuncts]
    body = next((group for group in [*named, *lent] if group.entry.known), next(iter([*named, *lent]), None))
    if body is None and len(wanted) > 1 and not wholes:
        between = {token.text for token in tokens[wanted[0].behind : wanted[1].first]}
        if between & _HAS:  # "a butterfly with a crown"
            wanted = wanted[1:]
        elif between & _ONTO:  # "a crown on the butterfly"
            wanted = wanted[:1]
    if not wanted:
        said = [group for number, group in numbered if _gives(number, groups, tokens, table, body is None)]
        wanted = [group for group in said if group.entry.name not in removed]
    name = None if body is None or not body.entry.known else body.entry.name
    if wholes and body is None:
        whole = wholes[0]
        name = table.whole_bodies.get(whole.entry.phrase or "")
        same = all(group.entry.name == whole.entry.name for group in wanted)
        if whole.entry.name not in removed and same:  # "a unicorn", "a unicorn with a pointed horn"
            return Subjects(whole, name, _one_a_part([group for group in wanted if group is not whole]) or (whole,))
    return Subjects(body, name, _one_a_part(wanted))


def _gives(number: int, groups: Sequence[Group], tokens: Sequence[Token], table: WordTable, bodiless: bool) -> bool:
    """Whether a whole or an adjective asks for its part: "turn it into a unicorn", "a winged dog", "make it spiky"."""
    group = groups[number]
    if group.entry.kind == "whole":
        return True
    if group.entry.kind != "attribute":
        return False
    if any(number in other.within and other.entry.kind in ("body", "whole") for other in groups):
        return True
    if bodiless and not _HAS & {token.text for token in tokens[: group.first]}:  # "a horned beast"
        return True
    following = tokens[group.behind] if group.behind < len(tokens) else Token(".")
    return following.is_stop or following.text in table.function


def _one_a_part(groups: Sequence[Group]) -> tuple[Group, ...]:
    first: dict[str, Group] = {}
    for group in groups:
        first.setdefault(group.entry.name, group)
    return tuple(first.values())


def _is_of_a_part(number: int, groups: Sequence[Group], tokens: Sequence[Token]) -> bool:
    """Whether it says what another part consists of: "a crown of flowers"."""
    if number == 0 or groups[number - 1].entry.kind != "part":
        return False
    before, group = groups[number - 1], groups[number]
    return [token.text for token in tokens[before.behind : group.begin]] == ["of"]


def _is_place(group: Group, groups: Sequence[Group], tokens: Sequence[Token], table: WordTable) -> bool:
    """Whether a word such as "head" says where on a body: "on its head", "on the dog's head", "the head of the dog"."""

    def may_be(one: Group) -> bool:
        return one.entry.kind == "body" and {token.text for token in tokens[one.first : one.behind]} <= table.places

    if not may_be(group):
        return False
    another = any(one.entry.kind == "body" and not may_be(one) for one in groups)
    return another or group.determiner in _OWNERS
