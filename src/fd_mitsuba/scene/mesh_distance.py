"""Distances and winding numbers of a triangle soup: the only place that asks libigl for them.

`igl.signed_distance` is not used. With the fast winding number it scales the distance by `1 - 2 w` instead of taking
that number's sign, which is off by 0.2 % on a closed sphere and arbitrarily wrong on an open mesh. Distance and
winding number are computed apart here, and the sign is inside **positive**.
"""

from __future__ import annotations

import igl
import numpy as np

from fd_mitsuba.scene.doubled_faces import without_reversed_copies

_CHUNK = 200_000


class MeshDistance:
    """Distance queries against one triangle soup, whose search trees are built once.

    Args:
        vertices: (V, 3), any frame and unit; finite.
        faces: (F, 3) indices into `vertices`, at least one face. Open meshes, several overlapping components,
            duplicate vertices, zero-area faces and faces that are there once each way round are fine.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self._faces = np.ascontiguousarray(faces, dtype=np.int64)
        if not len(self._faces):
            raise ValueError("a distance needs at least one face")
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        self._winding = igl.FastWindingNumberBVH()
        self._winding.init(self._vertices, without_reversed_copies(self._vertices, self._faces))

    def unsigned(self, points: np.ndarray) -> np.ndarray:
        """(N,) float64 distance to the nearest face, exact to rounding; `points` is (N, 3) in the mesh's frame."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        squared = np.empty(len(points))
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK]
            squared[start : start + _CHUNK] = self._tree.squared_distance(self._vertices, self._faces, part)[0]
        return np.sqrt(squared)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest face of each point (N,) int64, and where on it (N, 3) float64: weights of its corners.

        Of several faces that are equally near, any; the weights are >= 0 and sum to 1, on a zero-area face too.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        face, foot = np.empty(len(points), dtype=np.int64), np.empty((len(points), 3))
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK]
            _, face[start : start + _CHUNK], foot[start : start + _CHUNK] = self._tree.squared_distance(
                self._vertices, self._faces, part
            )
        return face, _corner_weights(self._vertices[self._faces[face]], foot)

    def feet(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) float64 the nearest point of the mesh to each of `points` (N, 3)."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        foot = np.empty((len(points), 3))
        for start in range(0, len(points), _CHUNK):
            part = points[start : start + _CHUNK]
            foot[start : start + _CHUNK] = self._tree.squared_distance(self._vertices, self._faces, part)[2]
        return foot

    def winding_number(self, points: np.ndarray) -> np.ndarray:
        """(N,) float64 generalised winding number: 1 inside a closed outward mesh, 0 outside, between for open ones."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        number = np.empty(len(points))
        for start in range(0, len(points), _CHUNK):
            number[start : start + _CHUNK] = self._winding.winding_number(points[start : start + _CHUNK])
        return number

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: the absolute winding number exceeds 1/2, so that a mesh turned inside out is still solid."""
        return np.abs(self.winding_number(points)) > 0.5

    def signed(self, points: np.ndarray) -> np.ndarray:
        """(N,) float64 distance to the nearest face, positive inside (see `inside`), negative outside."""
        distance = self.unsigned(points)
        return np.where(self.inside(points), distance, -distance)


def _corner_weights(corners: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (N, 3) of points `foot` (N, 3) on triangles `corners` (N, 3, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weights = np.stack(
        [
            np.einsum("ij,ij->i", np.cross(corners[:, (i + 1) % 3] - foot, corners[:, (i + 2) % 3] - foot), normal)
            for i in range(3)
        ],
        axis=1,
    ).clip(min=0)
    total = weights.sum(axis=1, keepdims=True)
    flat = total[:, 0] <= 0
    weights[flat], total[flat] = [1.0, 0.0, 0.0], 1.0
    return weights / total
