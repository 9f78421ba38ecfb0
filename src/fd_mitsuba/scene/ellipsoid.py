"""The exact signed distance to an ellipsoid that is given as an affine image of the unit sphere."""

from __future__ import annotations

import numpy as np

_CHUNK = 250_000


def ellipsoid_sdf(points: np.ndarray, to_frame: np.ndarray) -> np.ndarray:
    """Signed distance (N,) float32 to the image of the unit sphere under `to_frame`, inside positive.

    The map's linear part is U diag(e) V^T; the sphere does not see V, so the axes are U, the half lengths e.
    For a point y in these axes (taken to the positive octant) the closest point is e_i^2 y_i / (t + e_i^2), where
    t is the largest root of g(t) = sum (e_i y_i / (t + e_i^2))^2 - 1. There g is convex and falling: Newton's method
    that starts left of the root cannot overshoot. Error below 1e-6 of the longest half axis.

    Args:
        points: (N, 3) in the frame that `to_frame` maps into.
        to_frame: (4, 4) affine map that is not singular.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    axes, half, _ = np.linalg.svd(np.asarray(to_frame, dtype=np.float64)[:3, :3])
    centre = np.asarray(to_frame, dtype=np.float64)[:3, 3]
    distance = np.empty(len(points), dtype=np.float32)
    for start in range(0, len(points), _CHUNK):
        local = np.abs((points[start : start + _CHUNK] - centre) @ axes)
        distance[start : start + _CHUNK] = _axis_aligned(local, half)
    return distance


def _axis_aligned(y: np.ndarray, half: np.ndarray) -> np.ndarray:
    # On a symmetry plane the closest point may leave the plane, where the formula divides 0 by 0; a nudge decides it.
    y = np.maximum(y, 1e-9 * half[0])
    squared = half**2
    t = np.max(half * y - squared, axis=1)
    for _ in range(30):
        denominator = t[:, None] + squared
        ratio = half * y / denominator
        value = np.sum(ratio**2, axis=1) - 1.0
        slope = -2.0 * np.sum(ratio**2 / denominator, axis=1)
        step = -value / slope
        t = t + np.maximum(step, 0.0)
        if np.all(step <= 1e-12 * squared[0]):
            break
    closest = squared * y / (t[:, None] + squared)
    inside = np.sum((y / half) ** 2, axis=1) < 1.0
    length = np.linalg.norm(y - closest, axis=1)
    return np.where(inside, length, -length)
