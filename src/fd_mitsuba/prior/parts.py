"""The procedural parts that the built-in prior knows, with little jitter, so that one word means one shape."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.body import Body
from fd_mitsuba.prior.grown_parts import antlers, horn, horns, spikes, tail, wings
from fd_mitsuba.prior.placed_parts import butterfly, flower, handle, skateboard
from fd_mitsuba.prior.primitives import Solid
from fd_mitsuba.prior.worn_parts import backpack, cape, crown, glasses, pointed_hat, top_hat

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
