"""The procedural bodies that the built-in prior knows; front is +z, up is +y."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.data.animals import bird, fish, species, turtle
from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.figures import snowman, upright
from fd_mitsuba.prior.data.vessels import ball, vessel

BODIES: dict[str, Callable[[np.random.Generator], Body]] = {
    "horse": species(
        leg=0.95, length=0.62, girth=0.36, neck=0.75, neck_tilt=52, head=0.22, muzzle=0.3, ear=0.16, tail=0.7
    ),
    "dog": species(
        leg=0.6, length=0.5, girth=0.28, neck=0.34, neck_tilt=55, head=0.25, muzzle=0.2, ear=0.18, tail=0.35
    ),
    "cat": species(
        leg=0.5, length=0.48, girth=0.25, neck=0.26, neck_tilt=45, head=0.27, muzzle=0.04, ear=0.18, tail=0.6
    ),
    "deer": species(
        leg=1.0, length=0.52, girth=0.3, neck=0.65, neck_tilt=62, head=0.2, muzzle=0.22, ear=0.22, tail=0.15
    ),
    "cow": species(
        leg=0.6, length=0.65, girth=0.42, neck=0.4, neck_tilt=30, head=0.27, muzzle=0.26, ear=0.14, tail=0.6
    ),
    "pig": species(
        leg=0.34, length=0.5, girth=0.42, neck=0.26, neck_tilt=18, head=0.3, muzzle=0.16, ear=0.16, tail=0.12
    ),
    "bear": lambda rng: upright(
        rng, head=0.46, torso=0.5, belly=0.5, leg=0.45, arm=0.6, ear=0.1, ear_width=0.24, thick=0.36
    ),
    "rabbit": lambda rng: upright(
        rng, head=0.4, torso=0.42, belly=0.4, leg=0.34, arm=0.45, ear=0.6, ear_width=0.2, thick=0.32
    ),
    "person": lambda rng: upright(rng, head=0.3, torso=0.45, belly=0.38, leg=0.95, arm=0.75, ear=0.0, ear_width=0.1),
    "robot": lambda rng: upright(
        rng, head=0.38, torso=0.5, belly=0.52, leg=0.6, arm=0.75, ear=0.0, ear_width=0.1, boxy=True
    ),
    "snowman": snowman,
    "duck": bird,
    "turtle": turtle,
    "fish": fish,
    "vase": lambda rng: vessel(
        rng, [(0.4, 0), (0.52, 0.2), (0.78, 0.8), (0.7, 1.2), (0.4, 1.6), (0.34, 1.8), (0.46, 2.0)], 0.08
    ),
    "mug": lambda rng: vessel(
        rng, [(0.66, 0), (0.72, 0.06), (0.74, 0.6), (0.74, 1.2), (0.76, 1.62), (0.74, 1.66)], 0.03
    ),
    "pumpkin": lambda rng: vessel(
        rng, [(0.3, 0.02), (0.8, 0.2), (1.0, 0.7), (0.95, 1.1), (0.6, 1.42), (0.16, 1.45), (0.12, 1.7)], 0.05
    ),
    "ball": ball,
}
"""Every body word of the vocabulary and its maker."""
