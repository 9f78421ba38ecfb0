"""Shading normals for meshes without any: smooth, but for edges that are sharp."""

from __future__ import annotations

import numpy as np

SHARP_DEG = 40.0
"""Faces that meet at a larger angle than this keep an edge between them."""


def crease_normals(
    vertices: np.ndarray, faces: np.ndarray, groups: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals at corners, and the vertices that must be there twice for them.

    Corners are of one point where their positions are equal, so that UV seams do not show. A corner's normal is the
    mean of those of the faces around its point that make an angle of less than `SHARP_DEG` with its own face, weighted
    by area. With smoothing groups it is the mean of those that have a group in common with its own face.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        groups: (F,) whole numbers, a bit a group; a face of none is flat.

    Returns:
        (W,) for each new vertex the old one that it is a copy of, its normal (W, 3), and the new faces (F, 3).
    """
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(area, axis=1, keepdims=True)
    unit = area / np.maximum(length, 1e-300)
    point = np.unique(vertices + 0.0, axis=0, return_inverse=True)[1].reshape(-1)[faces].ravel()
    face = np.repeat(np.arange(len(faces)), 3)
    # The corners of each point lie side by side; each is compared with the next, the next but one, and so on.
    order = np.argsort(point, kind="stable")
    sorted_point, sorted_face = point[order], face[order]
    most = int(np.bincount(point).max(initial=0))
    total = area[sorted_face].copy()
    least = np.cos(np.radians(SHARP_DEG))
    for step in range(1, min(most, _MOST_FACES_AT_A_POINT)):
        here = np.nonzero(sorted_point[step:] == sorted_point[:-step])[0]
        if not len(here):
            break
        one, other = sorted_face[here], sorted_face[here + step]
        if groups is None:
            near = np.einsum("ij,ij->i", unit[one], unit[other]) > least
        else:
            near = (groups[one] & groups[other]) != 0
        np.add.at(total, here[near], area[other[near]])
        np.add.at(total, here[near] + step, area[one[near]])
    size = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.where(size > 0, total / np.maximum(size, 1e-300), [0.0, 0.0, 1.0])
    normals = np.empty_like(total)
    normals[order] = total
    # Sums of the same faces in another order differ in their last bits.
    keys = np.column_stack([faces.ravel(), np.round(normals * 1e5)]).astype(np.int64)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return faces.ravel()[first], normals[first], place.reshape(-1, 3)


_MOST_FACES_AT_A_POINT = 256
"""The tip of a finer fan is shaded by a part of its faces."""
