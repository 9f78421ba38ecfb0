"""Which words of a prompt stand under a negation: "without wings", "no horns or hats", "take the crown off".

Where a sentence can be read both ways a word counts as negated: what nobody asked for must not grow, and a prompt that
is refused can be said again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from fd_mitsuba.guidance.prompt_tokens import Token
from fd_mitsuba.guidance.word_table import Negation

_GOES_ON_WITH = frozenset("with wearing wears has have having add adds put puts give gives only just by for".split())
_BETWEEN = frozenset("is are was were has have been being all now completely".split())
_EMPHASIS = frozenset("only just".split())


def negated_words(tokens: Sequence[Token], parts: Collection[tuple[int, int]], words: Negation) -> set[int]:
    """Positions of the tokens under a negation.

    A negation goes on, over commas, "and" and "or", to the end of the sentence or to "but"; after the first part that
    it takes away also to "with", "has", "wearing", "put" and their like.

    Args:
        parts: first token and the one behind the last of every phrase that names a part.
    """
    inside = {place for first, behind in parts for place in range(first, behind)}
    found = {place for first, behind in parts if _taken_behind(tokens, behind, words) for place in range(first, behind)}
    active = part_seen = backdrop_seen = False
    for place, token in enumerate(tokens):
        if _starts(tokens, place, words) and not (place - 1 in found and token.text in words.after):
            active, part_seen, backdrop_seen = True, False, False
        elif active and (
            token.text in (".", "but")
            or (part_seen and token.text in _GOES_ON_WITH)
            or (backdrop_seen and not part_seen and token.is_stop)
        ):
            active = False
        elif active:
            found.add(place)
            part_seen = part_seen or place in inside
            backdrop_seen = backdrop_seen or token.text in words.backdrop
    for first, behind in parts:
        after = [token.text for token in tokens[behind : behind + 2]]
        if after[:1] == ["instead"] and after[1:] != ["of"]:
            found -= set(range(first, behind))
    return found


def says_no_to_a_no(tokens: Sequence[Token], parts: Collection[tuple[int, int]], words: Negation) -> bool:
    """Whether one negation follows another before any part is named: "do not remove the horns", "all except its hat".

    Such a prompt may mean the opposite of what `negated_words` makes of it, which is harmless where parts are added.
    """
    inside = {place for first, behind in parts for place in range(first, behind)}
    open_negation = False
    for place, token in enumerate(tokens):
        if _starts(tokens, place, words):
            if open_negation:
                return True
            open_negation = True
        elif place in inside or token.text == ".":
            open_negation = False
    return False


def _starts(tokens: Sequence[Token], place: int, words: Negation) -> bool:
    text = tokens[place].text
    following = tokens[place + 1].text if place + 1 < len(tokens) else ""
    if text in words.before or text in words.swaps:
        return not (text == "not" and following in _EMPHASIS)
    if any(_says(tokens, place, phrase) for phrase in words.phrases):
        return True
    if text in words.severing:
        for later in tokens[place + 1 :]:
            if later.text in ("off", "away"):
                return True
            if later.text in (".", "but", ","):
                break
    return False


def _says(tokens: Sequence[Token], place: int, phrase: str) -> bool:
    wanted = phrase.split()
    return [token.text for token in tokens[place : place + len(wanted)]] == wanted


def _taken_behind(tokens: Sequence[Token], behind: int, words: Negation) -> bool:
    while behind < len(tokens) and tokens[behind].text in (_BETWEEN | words.severing):  # "its tail cut off"
        behind += 1
    return behind < len(tokens) and tokens[behind].text in words.after
