"""The procedural parts that the built-in prior knows, with little jitter, so that one word means one shape."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.grown_parts import antlers, horn, horns, spikes, tail, wings
from fd_mitsuba.prior.data.placed_parts import butterfly, flower, handle, skateboard
from fd_mitsuba.prior.data.primitives import Solid, rotation, transform
from fd_mitsuba.prior.data.worn_parts import backpack, cape, crown, glasses, pointed_hat, top_hat

PARTS: dict[str, Callable[[Body, np.random.Generator], Solid]] = {
    "wings": wings,
    "horn": horn,
    "antlers": antlers,
    "pointed hat": pointed_hat,
    "top hat": top_hat,
    "crown": crown,
    "handle": handle,
    "skateboard": skateboard,
    "horns": horns,
    "cape": cape,
    "tail": tail,
    "glasses": glasses,
    "butterfly": butterfly,
    "flower": flower,
    "backpack": backpack,
    "spikes": spikes,
}
"""Every part word of the vocabulary and its maker."""

FEET: dict[str, Callable[[Body], np.ndarray]] = {
    "wings": lambda body: body.back,
    "horn": lambda body: body.forehead,
    "handle": lambda body: body.side,
    "tail": Body.rear,
    "backpack": lambda body: body.spine(5)[0][1:3].mean(axis=0),
} | dict.fromkeys(
    ("antlers", "horns", "pointed hat", "top hat", "crown", "butterfly", "flower"), lambda body: body.head_top
)
"""Where a part sits on its body; parts that must fit the body's shape (capes, glasses, boards, spikes) have none."""
_LEAST_SIZE, _MOST_SIZE, _MOST_TURN_DEG = 0.65, 1.2, 8.0


def resized(part: str, solid: Solid, body: Body, rng: np.random.Generator) -> Solid:
    """The part made smaller or larger, and tilted a little, about the point where it sits.

    People draw their regions smaller, larger and more askew than the makers place parts: a model that knows one size
    would fill a region to its border instead of shaping what fits.
    """
    if part not in FEET:
        return solid
    foot = FEET[part](body)
    size = np.exp(rng.uniform(np.log(_LEAST_SIZE), np.log(_MOST_SIZE)))
    turn = rotation(*rng.uniform(-_MOST_TURN_DEG, _MOST_TURN_DEG, 3))
    return transform(Solid((solid.vertices - foot) * size, solid.faces), turn, foot)
