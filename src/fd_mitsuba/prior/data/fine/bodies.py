"""The bodies of the finer prior: those of `data.bodies`, ten more, and heaps of simple solids without a name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.data.bodies import BODIES as COARSE_BODIES
from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.fine.creatures import dragon, elephant, head
from fd_mitsuba.prior.data.fine.things import car, chair, heap, house, shoe
from fd_mitsuba.prior.data.fine.vessels import bottle, teapot, tree

NAMELESS = "object"
BODIES: dict[str, Callable[[np.random.Generator], Body]] = {
    **COARSE_BODIES,
    "elephant": elephant,
    "dragon": dragon,
    "chair": chair,
    "car": car,
    "teapot": teapot,
    "bottle": bottle,
    "shoe": shoe,
    "house": house,
    "tree": tree,
    "head": head,
    NAMELESS: heap,
}
"""Every body word of the vocabulary and its maker."""
