"""Single rays at a mesh, in double precision and without Mitsuba: for the few questions that a place by words asks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


class TriangleRays:
    """Casts rays at triangles.

    Args:
        corners: (F, 3, 3); which side is outside follows from the volume that they enclose.

    >>> square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    >>> TriangleRays(square).first(np.array([0.2, 0.3, 2.0]), np.array([0, 0, -1.0])).tolist()
    [0.2, 0.3, 0.0]
    """

    def __init__(self, corners: Float[np.ndarray, "F 3 3"]) -> None:
        self._a, self._b, self._c = np.asarray(corners, dtype=np.float64).transpose(1, 0, 2)
        middle = self._a.mean(axis=0)
        volume = np.einsum("ij,ij->i", self._a - middle, np.cross(self._b - middle, self._c - middle)).sum()
        self._outward = -1 if volume < 0 else 1

    def first(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """(3,) the first point of the surface along a ray; None: it meets nothing."""
        distances, _ = self._crossings(origin, direction)
        return origin + distances[0] * direction if len(distances) else None

    def way_out(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """(3,) where a ray from within leaves the object, through whatever pieces overlap; None: it starts outside."""
        distances, leaves = self._crossings(origin, direction)
        # What is still to be left behind each crossing: nothing, at infinity.
        depth = np.concatenate([np.cumsum(leaves[::-1])[::-1], [0]])
        return origin + distances[np.argmax(depth[1:] <= 0)] * direction if depth[0] > 0 else None

    def _crossings(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (K,) to all triangles along a ray, nearest first; 1 where it goes out through them, -1 inwards."""
        a, b, c = self._a, self._b, self._c
        across = np.cross(direction, c - a)
        determinant = np.einsum("ij,ij->i", b - a, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / determinant
            offset = origin - a
            u = np.einsum("ij,ij->i", offset, across) * inverse
            turned = np.cross(offset, b - a)
            v = turned @ direction * inverse
            t = np.einsum("ij,ij->i", c - a, turned) * inverse
            found = np.flatnonzero((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0))
        found = found[np.argsort(t[found], kind="stable")]
        return t[found], -self._outward * np.sign(determinant[found]).astype(int)
