"""How good a surface's triangles are."""

from __future__ import annotations

import numpy as np


def smallest_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The smallest angle of each triangle, (F,) degrees; 60 at most, 0 without area."""
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    angles = []
    for corner in range(3):
        one = corners[:, (corner + 1) % 3] - corners[:, corner]
        other = corners[:, (corner + 2) % 3] - corners[:, corner]
        across = np.linalg.norm(np.cross(one, other), axis=1)
        angles.append(np.where(across > 0, np.arctan2(across, np.einsum("ij,ij->i", one, other)), 0.0))
    return np.degrees(np.min(angles, axis=0))
