"""A marched surface made into even triangles, all of them on the function, with vertices along the rim of the joint."""

from __future__ import annotations

import math

import numpy as np

from fd_mitsuba.export.final_surface.part_function import PartFunction
from fd_mitsuba.export.final_surface.projection import project
from fd_mitsuba.export.final_surface.remesh import remesh, tidied
from fd_mitsuba.export.final_surface.rim import drawn_to_rim, without_crossings
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles

_SHORTEST_CELLS = 0.2
"""Shorter edges than this, in cells of the training, show nothing more: the field's own cells are twice a cell."""
_MESHED = 0.9
"""Share of the budget that is aimed at: how many faces come out is known only afterwards."""
_TRIES = 3
"""Times that the edge is lengthened if there are still more faces than wanted."""
_RIM_ROUNDS = 3
_LEAST_ANGLE_DEG = 12.0
_LEAST_AT_RIM_DEG = 6.0


def edge_for(vertices: np.ndarray, triangles: np.ndarray, faces: int, cell: float) -> float:
    """The edge of equal triangles that cover a surface with the share of `faces` that is aimed at, or a longer one.

    Args:
        cell: of the training, in the vertices' unit.
    """
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return max(math.sqrt(4 * area / (math.sqrt(3) * _MESHED * faces)), _SHORTEST_CELLS * cell)


def evenly_meshed(
    function: PartFunction, vertices: np.ndarray, triangles: np.ndarray, faces: int, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), at most `faces` triangles (F, 3) or few more, and how far the vertices are from the zero set.

    Args:
        vertices: (V, 3). triangles: (F, 3), closed.
        step: the vertices are nearer to the zero set than this.

    Raises:
        ValueError: the surface is torn.
    """
    cell = function.grid.spacing
    edge = edge_for(vertices, triangles, faces, cell)

    def remeshed(
        vertices: np.ndarray, triangles: np.ndarray, edge: float, rounds: int
    ) -> tuple[np.ndarray, np.ndarray]:
        def onto(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            points, normals, _ = project(function.with_gradient, points, step, 1, 1e-3 * cell)
            return drawn_to_rim(function.rim, points, edge), normals

        return remesh(vertices, triangles, edge, onto, rounds)

    vertices, triangles = remeshed(vertices, triangles, edge, 6)
    for _ in range(_TRIES):
        if len(triangles) <= faces:
            break
        edge *= 1.05 * math.sqrt(len(triangles) / faces)
        vertices, triangles = remeshed(vertices, triangles, edge, 3)
    for _ in range(_RIM_ROUNDS):
        vertices = without_crossings(function.rim, vertices, triangles, edge, 1.0)
        vertices, triangles = remeshed(vertices, triangles, edge, 1)
    near = vertices
    for _ in range(2):
        near, triangles = tidied(near, triangles, edge)
        near = without_crossings(function.rim, near, triangles, edge, _LEAST_AT_RIM_DEG)
    exact, _, distance = project(function.with_gradient, near, step, 12, 1e-4 * cell)
    return _without_slivers(near, exact, triangles), triangles, distance


def _without_slivers(before: np.ndarray, after: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """`after`, but where triangles have become slivers their corners are as `before`, which is nearly as exact."""
    moved = after.copy()
    for _ in range(_TRIES):
        thin = smallest_angles(moved, triangles) < _LEAST_ANGLE_DEG
        if not thin.any():
            break
        corners = np.unique(triangles[thin])
        moved[corners] = before[corners]
    return moved
