"""Points spread evenly over triangles, to measure a surface at."""

from __future__ import annotations

import numpy as np


def surface_points(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` points (count, 3) float64 on the faces (F, 3), as many on equal areas, and the face of each (count,)."""
    rng = np.random.default_rng(seed)
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    ends = np.cumsum(area)
    face = np.searchsorted(ends, (np.arange(count) + rng.random(count)) / count * ends[-1]).clip(max=len(area) - 1)
    first, second = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - first, first * (1 - second), first * second], axis=1)
    return (weights[..., None] * corners[face]).sum(axis=1), face
