"""What a prior is shown: its bodies and parts, how often each, and which pairs of them never."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fd_mitsuba.prior.data import captions, looks
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.fine import captions as fine_captions
from fd_mitsuba.prior.data.fine import looks as fine_looks
from fd_mitsuba.prior.data.fine.bodies import BODIES as FINE_BODIES
from fd_mitsuba.prior.data.fine.bodies import NAMELESS
from fd_mitsuba.prior.data.fine.parts import PARTS as FINE_PARTS
from fd_mitsuba.prior.data.fine.parts import suits
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.looks import Material
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.data.primitives import Solid, join


@dataclass(frozen=True)
class Grown:
    """A part on a body.

    Attributes:
        zone_of: numbers of closed pieces, in the order in which they were joined -> numbers of zones of one material.
    """

    solid: Solid
    zone_of: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Catalogue:
    """Bodies and parts of one prior's training.

    Attributes:
        body_weights, part_weights: how often each is drawn, as weights; they list all there are.
        suits: (body, part) -> whether that part makes sense on that body.
        held_out: pairs that training never shows, so that an evaluation can ask for combinations of known words.
        make_body: (name, rng) -> a random body of that name.
        grow: (body, name, rng) -> a part on that body, as its maker places it.
        body_words, part_words: phrases for each, the usual one first.
        wholes: words that name a body together with its part.
        worn: parts that one wears.
        natural: looks that a part may have by nature, a material for each of its zones; `natural_styles` names some.
        vocabulary: every word of its captions.
        word_lists: what a user may write, as `guidance.vocabulary.Vocabulary` reads it.
    """

    body_weights: Mapping[str, float]
    part_weights: Mapping[str, float]
    suits: Callable[[str, str], bool]
    held_out: frozenset[tuple[str, str]]
    make_body: Callable[[str, np.random.Generator], Body]
    grow: Callable[[Body, str, np.random.Generator], Grown]
    body_words: Mapping[str, tuple[str, ...]]
    part_words: Mapping[str, tuple[str, ...]]
    wholes: Mapping[tuple[str, str], tuple[str, ...]]
    worn: Sequence[str]
    natural: Mapping[str, tuple[tuple[Material, ...], ...]]
    natural_styles: Mapping[str, str]
    vocabulary: Sequence[str]
    word_lists: Mapping[str, dict | list[str]]

    def parts_of(self, body: str) -> list[str]:
        """All parts that make sense on a body."""
        return [part for part in self.part_weights if self.suits(body, part)]

    def draw(self, rng: np.random.Generator) -> tuple[str, list[str | None]]:
        """A body and four of its parts, and in half of the cases None beside them, for the body alone."""
        bodies = list(self.body_weights)
        shares = np.array([self.body_weights[name] for name in bodies])
        body = str(rng.choice(bodies, p=shares / shares.sum()))
        parts = [part for part in self.parts_of(body) if (body, part) not in self.held_out]
        weights = np.array([self.part_weights[part] for part in parts])
        drawn: list[str | None] = [
            parts[i] for i in rng.choice(len(parts), size=4, replace=False, p=weights / weights.sum())
        ]
        return body, [*drawn, None] if rng.random() < 0.5 else drawn


OFTEN = ("horse", "cat", "dog", "snowman", "mug", "bear", "deer", "person", "rabbit", "cow", "vase")
"""Bodies that most of the coarse prior's pictures show; the others keep the copying of the base general."""
PART_SHARES: dict[str, float] = {
    **dict.fromkeys(("horn", "horns", "flower", "backpack", "spikes"), 3.0),
    **dict.fromkeys(("handle", "glasses", "antlers", "crown", "top hat", "skateboard", "tail"), 2.0),
}
"""How much more often than the others the coarse prior is shown parts of few pixels, and those that come out worst."""
COARSE = Catalogue(
    body_weights={name: 4.0 if name in OFTEN else 1.0 for name in BODIES},
    part_weights={part: PART_SHARES.get(part, 1.0) for part in PARTS},
    suits=lambda body, part: True,
    held_out=captions.HELD_OUT,
    make_body=lambda name, rng: BODIES[name](rng),
    grow=lambda body, name, rng: Grown(
        PARTS[name](body, rng), lambda piece: looks.zones(name, piece, piece.max(initial=-1) + 1)
    ),
    body_words=captions.BODY_WORDS,
    part_words=captions.PART_WORDS,
    wholes=captions.SYNONYM_WHOLES,
    worn=captions.WORN,
    natural=looks.NATURAL,
    natural_styles=looks.NATURAL_STYLE,
    vocabulary=captions.vocabulary(),
    word_lists=captions.word_lists(),
)


def _grow_fine(body: Body, name: str, rng: np.random.Generator) -> Grown:
    zones = FINE_PARTS[name](Surface(body), rng)
    zone_of_piece = fine_looks.zone_of_piece(zones)
    return Grown(join(list(zones.values())), lambda piece: zone_of_piece[piece])


_FINE_BODIES_OFTEN = {NAMELESS: 5.0, "person": 4.0, "head": 3.0} | dict.fromkeys(
    ("horse", "cat", "dog", "bear", "rabbit", "cow", "elephant", "dragon", "duck", "mug", "vase", "snowman", "robot"),
    2.0,
)
_FINE_PARTS_OFTEN = {"glasses": 3.0, "backpack": 2.0, "crown": 2.0, "skateboard": 2.0} | dict.fromkeys(
    ("pointed hat", "top hat", "horn", "horns", "antlers", "flower", "spikes", "handle", "wings", "cape"), 1.5
)
FINE = Catalogue(
    body_weights={name: _FINE_BODIES_OFTEN.get(name, 1.0) for name in FINE_BODIES},
    part_weights={part: _FINE_PARTS_OFTEN.get(part, 1.0) for part in FINE_PARTS},
    suits=suits,
    held_out=fine_captions.HELD_OUT,
    make_body=lambda name, rng: FINE_BODIES[name](rng),
    grow=_grow_fine,
    body_words=fine_captions.BODY_WORDS,
    part_words=fine_captions.PART_WORDS,
    wholes=fine_captions.SYNONYM_WHOLES,
    worn=fine_captions.WORN,
    natural={part: tuple(tuple(look.values()) for look in choices) for part, choices in fine_looks.NATURAL.items()},
    natural_styles=fine_looks.NATURAL_STYLE,
    vocabulary=fine_captions.vocabulary(),
    word_lists=fine_captions.word_lists(),
)
