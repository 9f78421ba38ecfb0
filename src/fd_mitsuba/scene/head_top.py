"""The top of a head, below ears, horns and combs: down through what is thin until it is as thick as a head."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_STEP, _DEEPEST = 0.015, 0.45
"""How far a step goes down, and how far all may, as shares of the object's height."""
_THICK = 0.07
"""Least thickness of a head, across and along, as a share of the longest side. An ear of Stanford's bunny has 0.045."""

Hit = Callable[[np.ndarray, np.ndarray], np.ndarray | None]
"""Origin and direction of a ray, (3,) each -> the first point of the surface along it, or None."""


def below_ears(point: np.ndarray, hit: Hit, longest_side: float, height: float) -> np.ndarray:
    """(3,) the surface above the first place at or below `point` that is as thick as a head; `point` where none is.

    Each step goes straight down and then to the middle of what is around it, so that it follows an ear that leans. One
    that slants more than it stands, cut level, is as thick as a head: there the place stays on it.

    Args:
        point: (3,) on the surface, seen from above, +y up.
        hit: casts rays at the object.

    >>> def ball(origin, direction):  # of radius 1 about 0, from within
    ...     along = origin @ direction
    ...     return origin + direction * (np.sqrt(along**2 + 1 - origin @ origin) - along)
    >>> bool(np.allclose(below_ears(np.array([0.1, 0.995, 0.0]), ball, 2.0, 2.0), [0, 1, 0], atol=1e-3))
    True
    """
    axes, inside = np.eye(3), np.array(point, dtype=np.float64)
    for _ in range(round(_DEEPEST / _STEP)):
        inside[1] -= _STEP * height
        thickness = []
        for axis in (0, 2):
            ends = [hit(inside, sign * axes[axis]) for sign in (1, -1)]
            if ends[0] is None or ends[1] is None:
                return point  # outside
            thickness.append(ends[0][axis] - ends[1][axis])
            inside[axis] = (ends[0][axis] + ends[1][axis]) / 2
        if min(thickness) >= _THICK * longest_side:
            above = hit(inside, axes[1])
            return point if above is None else above
    return point
