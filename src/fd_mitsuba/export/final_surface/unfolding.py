"""Vertices of a mesh moved without folding it: no triangle turns over, unless it looked inwards before."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.export.final_surface.mesh_rings import cross_of_faces
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles


def unfolded(
    before: np.ndarray,
    after: np.ndarray,
    faces: np.ndarray,
    least_angle_deg: np.ndarray | float = 0.0,
    free: np.ndarray | None = None,
) -> np.ndarray:
    """`after` (V, 3), but `before` around faces that turn over on the way, or get angles below `least_angle_deg`.

    Args:
        least_angle_deg: for all faces, or (F,) for each.
        free: (F,) bool, the faces that may turn over.
    """
    after = after.copy()
    cross = cross_of_faces(before, faces)
    while True:
        bad = np.einsum("ij,ij->i", cross, cross_of_faces(after, faces)) < 0
        if free is not None:
            bad &= ~free
        if np.any(least_angle_deg):
            bad |= smallest_angles(after, faces) < least_angle_deg
        corners = np.unique(faces[bad])
        corners = corners[(after[corners] != before[corners]).any(axis=1)]
        if not len(corners):
            return after
        after[corners] = before[corners]


def inverted(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Which faces (F,) look away from the surface's outward normals (V, 3): folds of the mesh that came in."""
    cross, facing = cross_of_faces(vertices, faces), normals[faces].sum(axis=1)
    scale = np.linalg.norm(cross, axis=1) * np.linalg.norm(facing, axis=1)
    return np.einsum("ij,ij->i", cross, facing) < -0.5 * scale
