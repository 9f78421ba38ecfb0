"""Points brought onto a function's zero set by Newton steps along the gradient."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

WithGradient = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points (N, 3) -> values (N,) and gradients (N, 3)."""

FLATTEST = 0.1
"""A gradient is taken for at least so long: a flat spot of a field must not throw points away."""


def project(
    function: WithGradient, points: np.ndarray, longest: float, steps: int, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) on the zero set, the unit normals (N, 3) that point to smaller values, and what is left (N,).

        x <- x - value gradient / |gradient|^2

    A step that makes the value larger, as across a crease, is taken back and tried again a third as long. What is left
    is |value| / |gradient|.

    Args:
        longest: a step is never longer.
        near: points whose value is smaller stay where they are.
    """
    best = np.array(points, dtype=np.float64)
    value, gradient = function(best)
    share = np.ones(len(best))
    for _ in range(steps):
        moving = np.flatnonzero(np.abs(value) > near)
        if not len(moving):
            break
        slope = np.maximum(np.linalg.norm(gradient[moving], axis=1), FLATTEST)
        step = np.clip(value[moving] / slope, -longest, longest) / slope * share[moving]
        tried = best[moving] - step[:, None] * gradient[moving]
        tried_value, tried_gradient = function(tried)
        better = np.abs(tried_value) < np.abs(value[moving])
        taken = moving[better]
        best[taken], value[taken], gradient[taken] = tried[better], tried_value[better], tried_gradient[better]
        share[moving] = np.where(better, np.minimum(2 * share[moving], 1), share[moving] / 3)
    slope = np.linalg.norm(gradient, axis=1)
    normal = -gradient / np.maximum(slope, 1e-12)[:, None]
    return best, normal, np.abs(value) / np.maximum(slope, FLATTEST)
