"""What the evaluator's captions say, and of which pictures that is true.

The words are the prior's, the sentences are not. A caption makes a claim; a picture that satisfies it counts as a match
even if the caption was written for another one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fd_mitsuba.prior.data.captions import COLOURS, MATERIALS, styled
from fd_mitsuba.prior.data.catalogue import COARSE, Catalogue
from fd_mitsuba.prior.data.looks import STYLE_OF_WORD

STYLES = (*COLOURS, *MATERIALS)
ANY_STYLE, NO_STYLE = -1, -2
"""Of a claim or of a picture of normals: any colour; of a picture: a colour that has no word."""
NO_PART = -1
_DETAIL = ("highly detailed ", "cute ", "small ", "large ", "beautiful ", "realistic ", "tall ", "round ")
_WITH_PART = (
    "a picture of a {s} that has {p}",
    "{s}, {p}",
    "{p}, {s}",
    "the {s} with {p}",
    "the {s} has {p}",
    "view of a {s} with {p}",
    "{p} on the {s}",
    "{s} and {p}",
    "picture of one {s} with {p}",
)
_WORN = ("a picture of the {s} wearing {p}", "{s} wearing {p}")
_RIDDEN = ("the {s} standing on {p}", "picture of the {s} riding {p}", "{s} on {p}")
_PLAIN = ("a picture of a {s}", "{s}", "the {s}", "view of a {s}", "picture of one {s}", "a {s}")
_LETTERS = np.array(list("abcdefghijklmnoprstuvwxyz"))


class Claim(NamedTuple):
    """What a caption says or a picture shows: numbers of bodies and parts in a catalogue, and in `STYLES`."""

    body: int
    part: int
    part_style: int
    body_style: int


def true_of(captions: np.ndarray, pictures: np.ndarray) -> np.ndarray:
    """Which claims of captions (M, 4) hold for pictures (N, 4): (N, M) bool.

    A caption without a part claims that there is none.
    """
    said, shown = captions[None], pictures[:, None]
    same = said == shown
    free = (said == ANY_STYLE) | (shown == ANY_STYLE)
    return same[..., 0] & same[..., 1] & (same | free)[..., 2] & (same | free)[..., 3]


def write_caption(shown: Claim, rng: np.random.Generator, catalogue: Catalogue = COARSE) -> tuple[str, Claim]:
    """A caption that is true of a picture, and what it claims.

    Of normals it may name any colour: they do not show one. Now and then it has a word that means nothing, so that the
    evaluator learns to pass over words it does not know.
    """
    part_style, body_style = (_style_to_name(style, rng) for style in (shown.part_style, shown.body_style))
    body = list(catalogue.body_words)[shown.body]
    part = None if shown.part == NO_PART else list(catalogue.part_words)[shown.part]
    nouns, whole = list(catalogue.body_words[body]), False
    if part and (body, part) in catalogue.wholes and part_style == ANY_STYLE and rng.random() < 0.25:
        nouns, whole = list(catalogue.wholes[(body, part)]), True
    adjective = str(rng.choice(_DETAIL)) if rng.random() < 0.25 else ""
    subject = adjective + styled(str(rng.choice(nouns)), _word(body_style, rng))
    if part is None or (whole and rng.random() < 0.5):
        text = str(rng.choice(_PLAIN)).format(s=subject)
        part_style = ANY_STYLE
    else:
        phrases = [p for p in catalogue.part_words[part] if not STYLE_OF_WORD.keys() & set(p.split())]
        phrase = styled(str(rng.choice(phrases)), _word(part_style, rng))
        if rng.random() < 0.2:
            phrase = phrase.removeprefix("a pair of ").removeprefix("a ")
        templates = _RIDDEN + _WITH_PART[:6] if part == "skateboard" else _WITH_PART
        text = str(rng.choice(templates + _WORN * 2 if part in catalogue.worn else templates)).format(
            s=subject, p=phrase
        )
    if rng.random() < 0.1:
        words = text.split(" ")
        words.insert(int(rng.integers(len(words) + 1)), "".join(rng.choice(_LETTERS, rng.integers(4, 9))))
        text = " ".join(words)
    return text, Claim(shown.body, shown.part, part_style, body_style)


def _style_to_name(style: int, rng: np.random.Generator) -> int:
    if style == ANY_STYLE:
        return int(rng.integers(len(STYLES))) if rng.random() < 0.2 else ANY_STYLE
    return style if style != NO_STYLE and rng.random() < 0.6 else ANY_STYLE


def _word(style: int, rng: np.random.Generator) -> str:
    if style == ANY_STYLE:
        return ""
    name = STYLES[style]
    return str(rng.choice(MATERIALS[name])) if name in MATERIALS else name
