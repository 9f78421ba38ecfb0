"""Where and how large a part is: people draw regions smaller, larger, askew, and not where the makers would."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.data.fine.parts import FITTED, ON_BACK, ON_HEAD, ON_SIDE
from fd_mitsuba.prior.data.fine.shapes import frame_towards, unit
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import Solid, mirror_x, rotation, transform

Rng = np.random.Generator
MOVED_SHARE = 0.15
"""Parts that sit somewhere else on the surface: a model that knows one place a body cannot follow a region."""
MIRRORED_SHARE = 0.25
"""Of the parts at a side, those at the other one."""
LEAST_SIZE, MOST_SIZE, MOST_TURN_DEG = 0.7, 1.25, 10.0

FEET: dict[str, Callable[[Surface], np.ndarray]] = (
    dict.fromkeys(ON_HEAD, lambda surface: surface.body.head_top)
    | dict.fromkeys(ON_BACK, lambda surface: surface.body.back)
    | dict.fromkeys(ON_SIDE, lambda surface: surface.body.side)
    | {
        "horn": lambda surface: surface.body.forehead,
        "tail": lambda surface: surface.body.rear(),
        "tusks": lambda surface: surface.mouth(),
    }
)
"""Where a part sits; parts of `parts.FITTED` hug the body and have none."""


def varied(part: str, solid: Solid, surface: Surface, rng: Rng) -> Solid:
    """The part made smaller or larger and tilted about where it sits; now and then mirrored or moved elsewhere."""
    if part in FITTED:
        return solid
    foot = FEET[part](surface)
    size = np.exp(rng.uniform(np.log(LEAST_SIZE), np.log(MOST_SIZE)))
    turn = rotation(*rng.uniform(-MOST_TURN_DEG, MOST_TURN_DEG, 3))
    local = transform(Solid((solid.vertices - foot) * size, solid.faces), turn)
    if rng.random() < MOVED_SHARE:
        return _elsewhere(part, local, foot, surface, rng)
    made = transform(local, shift=foot)
    return mirror_x(made) if part in ON_SIDE and rng.random() < MIRRORED_SHARE else made


def _elsewhere(part: str, local: Solid, foot: np.ndarray, surface: Surface, rng: Rng) -> Solid:
    """The part, given about its foot, on another point of the surface."""
    low, high = surface.body.solid.vertices.min(0), surface.body.solid.vertices.max(0)
    if part in ON_SIDE:
        turn = rotation(degrees_y=rng.uniform(-180, 180))
        out = turn @ np.array([1.0, 0, 0])
        through = np.array([0, foot[1] + rng.uniform(-0.3, 0.3) * surface.body.side_height, foot[2]])
        point, hit = surface.cast((through + 3 * out)[None], -out)
        gap = foot[0] - surface.towards(foot, (-1, 0, 0))[0, 0]
        return transform(local, turn, point[0] + gap * out) if hit[0] else transform(local, shift=foot)
    if part in ON_BACK or part in ("tail", "tusks"):
        shift = rng.uniform(-0.18, 0.18, 3) * (0, 1, 1) * surface.body.reach
        return transform(local, shift=foot + shift)
    x, z = rng.uniform(0.75 * low[[0, 2]], 0.75 * high[[0, 2]])
    if rng.random() < 0.5:
        x = 0.0
    origins = np.array([[x, high[1] + 1, z], [x + 0.05, high[1] + 1, z], [x, high[1] + 1, z + 0.05]])
    points, hit = surface.cast(origins, np.array([0, -1.0, 0]))
    if not hit.all():
        return transform(local, shift=foot)
    normal = np.cross(points[2] - points[0], points[1] - points[0])
    turn = frame_towards(unit(unit(normal) + (0, 0.8, 0))) @ rotation(degrees_y=rng.uniform(-60, 60))
    return transform(local, turn, points[0] + (foot - surface.towards(foot, (0, -1, 0))[0]) * (0, 1, 0))
