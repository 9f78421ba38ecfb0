"""Shading normals of a final surface: as smooth as the shape that a training can have meant, its edges kept.

A field on a hash grid is linear between the grid's points, so its gradient jumps where it passes from one cell to the
next. On a mirror each jump is a torn reflection. The mesh's own normals have half of that noise; means over the
triangles around, a fraction of a training cell wide, have a third.
"""

from __future__ import annotations

import numpy as np

from fd_mitsuba.export.final_surface.mesh_rings import edges_of
from fd_mitsuba.scene.vertex_normals import vertex_normals

_WIDTH_CELLS = 0.26
"""Standard deviation of the average along the surface, in cells of the training; a cell of the field has two."""
_A_ROUND = 0.6
"""That of one round, in edges."""
_MOST_ROUNDS = 16
_SHARPNESS = 8.0
"""A neighbour counts cos(angle)^8: nine tenths at 9 degrees, a sixteenth at an edge of 45."""


def smooth_normals(
    vertices: np.ndarray, faces: np.ndarray, cell: float, known: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """Unit normals (V, 3) float64 of a closed, manifold mesh of even triangles, averaged along the surface.

    Neighbours that look elsewhere hardly count, so that an edge stays an edge.

    Args:
        cell: of the training, in the vertices' unit.
        known: vertices (K,) and the unit normals (K, 3) there, in place of the mesh's own.
    """
    normals = vertex_normals(vertices, faces)
    if known is not None:
        normals[known[0]] = known[1]
    ends = edges_of(faces, len(vertices)).ends
    edge = float(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1).mean())
    rounds = min(round((_WIDTH_CELLS * cell / (_A_ROUND * max(edge, 1e-12))) ** 2), _MOST_ROUNDS)
    for _ in range(rounds):
        one, other = normals[ends[:, 0]], normals[ends[:, 1]]
        weight = np.einsum("ij,ij->i", one, other).clip(min=0) ** _SHARPNESS
        total = normals.copy()
        for axis in range(3):
            total[:, axis] += np.bincount(ends[:, 0], weight * other[:, axis], len(normals))
            total[:, axis] += np.bincount(ends[:, 1], weight * one[:, axis], len(normals))
        normals = total / np.linalg.norm(total, axis=1, keepdims=True)
    return normals
