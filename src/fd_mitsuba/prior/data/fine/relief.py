"""Features that a body's maker does not give it: noses, cheeks, bulging eyes, tufts, bumps anywhere.

Bodies of a few smooth solids have bare faces; people's meshes have not. A prior that never saw a muzzle takes one for
something to be replaced, and glasses that it draws there are crumbs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.primitives import Solid, ellipsoid, join, mirror_x, rotation

Rng = np.random.Generator
_ON_HEAD, _ANYWHERE = 6, 4
"""Features at most, of the head and of the whole body."""
_MIRRORED = 0.7
_EXPONENTS = (1.0, 1.0, 0.6)


def with_relief(body: Body, rng: Rng) -> Body:
    """The body with up to ten more bumps, half of each within it; its anchors stay."""
    radius = body.head_radius
    points = body.solid.vertices
    head = body.head_top - np.array([0, 0.95 * radius, 0])
    near = points[np.linalg.norm(points - head, axis=1) < 1.4 * radius]
    bumps: list[Solid] = []
    for _ in range(rng.integers(0, _ON_HEAD + 1)):
        bumps += _bump(near if len(near) else points, radius * rng.uniform(0.08, 0.38, 3), rng)
    if rng.random() < 0.4:
        at = body.eyes()[0] - np.array([0, rng.uniform(0.2, 0.9) * radius, 0])
        muzzle = radius * rng.uniform((0.2, 0.15, 0.2), (0.6, 0.4, 0.7))
        bumps.append(ellipsoid((0, at[1], at[2]), muzzle, exponent=rng.choice(_EXPONENTS)))
    if rng.random() < 0.3:
        eye, size = body.eyes()[0], radius * rng.uniform(0.12, 0.3)
        bumps += [ball := ellipsoid(eye, (size, size, 0.8 * size)), mirror_x(ball)]
    for _ in range(rng.integers(0, _ANYWHERE + 1)):
        bumps += _bump(points, body.reach * rng.uniform(0.03, 0.2, 3), rng)
    return replace(body, solid=join([body.solid, *bumps]))


def _bump(points: np.ndarray, half_axes: np.ndarray, rng: Rng) -> list[Solid]:
    at = points[rng.integers(len(points))]
    one = ellipsoid(at, half_axes, rotation(*rng.uniform(-60, 60, 3)), exponent=rng.choice(_EXPONENTS))
    return [one, mirror_x(one)] if rng.random() < _MIRRORED else [one]
