"""Vertices of a mesh put along the rim where the solid dives under the base, so that the joint is no zigzag.

The fillet ends low over the base, and nearly parallel to it: a triangle across the rim would cut it off, and end on the
base somewhere else than its neighbour does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.export.final_surface.mesh_rings import edges_of
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.export.final_surface.unfolding import unfolded

Rim = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]
"""Points (N, 3) and a distance -> two values (N, 2), both 0 on the rim, and their gradients (N, 2, 3); infinite where
the first is larger than the distance."""

_NEAR = 0.4
"""Vertices as near to the rim as this, in edges, are drawn to it."""
_ON = 0.02
"""A vertex as near as this, in edges, is on it."""
_BESIDE = 0.2
"""A vertex so little before the rim, as a share of what is shaded beyond it, has faces that dive, too."""
_BELOW = 2.0
"""How far below the fillet, in edges, the other end of an edge that starts on it can be."""
_STEPS = 5
_WITHIN = 2.5
"""What is farther beyond the rim, in edges, has no edge across it."""


def drawn_to_rim(rim: Rim, points: np.ndarray, edge: float) -> np.ndarray:
    """Points (N, 3) of the surface, those near the rim moved onto it.

    Args:
        edge: the mesh's, in the points' unit.
    """
    near = np.flatnonzero(_distance(rim, points, edge) < _NEAR * edge)
    moved, there = _onto(rim, points[near], edge)
    points = points.copy()
    points[near[there]] = moved[there]
    return points


def without_crossings(
    rim: Rim, vertices: np.ndarray, faces: np.ndarray, edge: float, least_angle_deg: float
) -> np.ndarray:
    """Vertices (V, 3), moved so that hardly an edge crosses the rim: of each that does, an end goes there.

    That is the nearer one, or the other where triangles would turn over or get smaller angles than `least_angle_deg`.
    """
    ends = edges_of(faces, len(vertices)).ends
    angles = np.minimum(smallest_angles(vertices, faces), least_angle_deg)
    for farther in (False, True):
        side = _side(rim, vertices, edge)
        one, other = side[ends[:, 0]], side[ends[:, 1]]
        crossing = ends[(np.minimum(one, other) < -_ON * edge) & (np.maximum(one, other) > _ON * edge)]
        first_is_nearer = np.abs(side[crossing[:, 0]]) < np.abs(side[crossing[:, 1]])
        chosen = np.unique(np.where(first_is_nearer != farther, crossing[:, 0], crossing[:, 1]))
        moved, there = _onto(rim, vertices[chosen], edge)
        tried = vertices.copy()
        tried[chosen[there]] = moved[there]
        vertices = unfolded(vertices, tried, faces, angles)
    return vertices


def rim_normals(rim: Rim, vertices: np.ndarray, below: float) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices (K,) lie on the rim, just before it, or beyond it by up to `below`, and unit normals (K, 3) there.

    They are those of the fillet, as if it went on: what is seen between the rim and the base is a hair's breadth, and
    shaded as the flank that it is it would be a dark line around the part.
    """
    values, gradients = rim(vertices, 2 * below)
    side = values[:, 0] / np.maximum(np.linalg.norm(gradients[:, 0], axis=1), 1e-3)
    chosen = np.flatnonzero((side > -_BESIDE * below) & (side < below) & (np.abs(values[:, 1]) < _BELOW * below))
    slope = gradients[chosen, 1]
    length = np.linalg.norm(slope, axis=1)
    chosen, slope, length = chosen[length > 0.1], slope[length > 0.1], length[length > 0.1]
    return chosen, -slope / length[:, None]


def _side(rim: Rim, points: np.ndarray, edge: float) -> np.ndarray:
    """How far (N,) beyond the rim points are, negative on the fillet; NaN where the rim is nowhere near."""
    values, gradients = rim(points, _WITHIN * edge)
    side = values[:, 0] / np.maximum(np.linalg.norm(gradients[:, 0], axis=1), 1e-3)
    return np.where(np.isfinite(values).all(axis=1) & (np.abs(values[:, 1]) < _BELOW * edge), side, np.nan)


def _distance(rim: Rim, points: np.ndarray, edge: float) -> np.ndarray:
    values, gradients = rim(points, _WITHIN * edge)
    return (np.abs(values) / np.maximum(np.linalg.norm(gradients, axis=2), 1e-3)).max(axis=1)


def _onto(rim: Rim, points: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) on the rim by the shortest way, and which of them (N,) got there within an edge."""
    moved = np.array(points, dtype=np.float64)
    for _ in range(_STEPS):
        values, gradients = rim(moved, _WITHIN * edge)
        finite = np.isfinite(values).all(axis=1)
        jacobian = gradients[finite]
        square = jacobian @ jacobian.transpose(0, 2, 1) + 1e-4 * np.eye(2)
        step = (jacobian.transpose(0, 2, 1) @ np.linalg.solve(square, values[finite][..., None]))[..., 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        moved[finite] -= step * np.minimum(1, 0.5 * edge / np.maximum(length, 1e-12))
    there = _distance(rim, moved, edge) < _ON * edge
    return moved, there & (np.linalg.norm(moved - points, axis=1) < edge)
