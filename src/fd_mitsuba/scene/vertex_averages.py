"""Normals at the vertices of a mesh, from the faces around them."""

from __future__ import annotations

import numpy as np


def face_normals_at_vertices(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit mean of the normals of the faces around each vertex by their area; 0 where there is none.

    Vertices at one position count as one, so that a seam of UVs does not show.
    """
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, place = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    place = place.reshape(-1)
    count, at = int(place.max(initial=-1)) + 1, place[faces].ravel()
    total = np.stack([np.bincount(at, np.repeat(axis, 3), minlength=count) for axis in normal.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), 0.0)[place]


def vertices_with_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Numbers of the vertices that are a corner of a face with an area."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.unique(faces[area > 0])
