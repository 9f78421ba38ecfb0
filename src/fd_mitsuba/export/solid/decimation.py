"""Fewer faces for a solid: as many as asked for, or as few as still hold it together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import fast_simplification
import manifold3d
import numpy as np

from fd_mitsuba.export.solid.solid import Solid

_VOLUME_KEPT = 0.98
"""Share of the volume that a good decimation leaves; a budget that is too small for the shape leaves less."""
_VOLUME_LEFT = 0.5
"""A decimation that leaves less has lost the shape."""
_AGGRESSIVENESS = (5.0, 7.0)
"""Of the quadric edge collapses; the higher one gets to lower numbers."""
_APART = 2e-4
"""How far sheets that touch are moved apart, as a share of the solid's size."""
_MORE = 1.25


def decimated(solid: Solid, faces: int) -> Solid:
    """The solid with at most `faces` faces; with more only where so few do not hold it together.

    Unchanged where it has no more than that. Quadric edge collapses, and where two sheets have come to touch in an
    edge, they are moved apart there: the result is a solid like the given one.
    """
    wanted = faces
    while faces < len(solid.faces):
        found = [made for made in _attempts(solid, faces) if made.volume >= _VOLUME_LEFT * solid.volume]
        if found:
            met = [made for made in found if len(made.faces) <= wanted]
            return max(met, key=lambda made: made.volume) if met else min(found, key=lambda made: len(made.faces))
        faces = int(faces * _MORE) + 1
    return solid


def _attempts(solid: Solid, faces: int) -> Iterator[Solid]:
    """Solids of about `faces` faces, no further ones once one is good."""
    for aggressiveness in _AGGRESSIVENESS:
        simpler: Any = fast_simplification.simplify(  # a pair, unless it is asked for the steps that led there
            solid.vertices, solid.faces.astype(np.int32), target_count=faces, agg=aggressiveness
        )
        points, triangles = simpler
        made = replace(solid, vertices=points, faces=triangles)
        if not made.manifold:
            made = _parted(made)
        if made.manifold:
            yield made
            if len(made.faces) <= faces and _VOLUME_KEPT <= made.volume / solid.volume <= 2 - _VOLUME_KEPT:
                return


def _parted(solid: Solid) -> Solid:
    """The solid with sheets that share an edge drawn back from each other, each into its own inside."""
    made = solid.to_manifold()  # which gives each sheet vertices of its own
    if made.status() != manifold3d.Error.NoError or made.is_empty():
        return solid
    mesh = made.to_mesh()
    points, faces = np.array(mesh.vert_properties[:, :3], np.float64), np.array(mesh.tri_verts, np.int64)
    _, place, count = np.unique(points.astype(np.float32), axis=0, return_inverse=True, return_counts=True)
    shared = count[place.ravel()] > 1
    corners = points[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    points[shared] -= _APART * np.ptp(points, axis=0).max() * normals[shared]
    return replace(solid, vertices=points, faces=faces)
