"""Smooth normals at the vertices of a mesh, from the faces around them: the one place for meshes that stay as they are.

`render/vertex_normals.py` has those of a mesh that is being optimised, with their derivative.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

_NO_NORMAL = (0.0, 1.0, 0.0)
_CANCELS = 1e-12
"""A sum this much shorter than what was added up points nowhere."""


def vertex_normals(
    vertices: np.ndarray, faces: np.ndarray, weights: Literal["angle", "area"] = "angle", welded: bool = False
) -> np.ndarray:
    """Unit normals (V, 3) float64: the mean of the normals of the faces around each vertex.

    Weighted by the faces' angles at the vertex it does not depend on how a surface is cut into triangles, and is what
    Mitsuba computes itself. By area is for what must look like the geometry pass, which takes areas because their
    derivative is bounded.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        weights: what a face counts for.
        welded: whether vertices at one position count as one, so that a seam of UVs does not show.

    Where no face has an area, or the faces cancel, it is +y.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    corners, place = vertices[faces], np.arange(len(vertices))
    if welded:
        place = np.unique(vertices + 0.0, axis=0, return_inverse=True)[1].reshape(-1)
    total, added = np.zeros((len(vertices), 3)), np.zeros((len(vertices), 1))
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weight = np.linalg.norm(flat, axis=1)
    flat = unit_vectors(flat)
    for corner in range(3):
        if weights == "angle":
            sides = (corners[:, (corner + step) % 3] - corners[:, corner] for step in (1, 2))
            weight = angles_between(*sides)
        add_rows(total, place[faces[:, corner]], flat * weight[:, None])
        add_rows(added, place[faces[:, corner]], weight[:, None])
    total[np.linalg.norm(total, axis=1) <= _CANCELS * added[:, 0]] = _NO_NORMAL
    return unit_vectors(total)[place]


def vertices_with_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Numbers of the vertices that are a corner of a face with an area."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.unique(faces[area > 0])


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) at length one; those without a length stay 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-30, vectors / np.maximum(length, 1e-30), 0.0)


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles (N,) in radians, 0 to pi, between vectors (N, 3) of any length."""
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ij,ij->i", first, second))


def add_rows(target: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
    """Add values (N, C) to the given rows (N,) of the target (V, C), which may repeat, in their order."""
    for column in range(target.shape[1]):
        target[:, column] += np.bincount(rows, weights=values[:, column], minlength=len(target))
