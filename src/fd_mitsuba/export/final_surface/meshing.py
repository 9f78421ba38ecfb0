"""A marched surface made into even triangles, all of them on the function, with vertices along the rim of the joint."""

from __future__ import annotations

import math

import igl
import numpy as np

from fd_mitsuba.export.final_surface.mesh_rings import edges_of
from fd_mitsuba.export.final_surface.part_function import PartFunction
from fd_mitsuba.export.final_surface.projection import FLATTEST, project
from fd_mitsuba.export.final_surface.remesh import halved, remesh, tidied
from fd_mitsuba.export.final_surface.rim import drawn_to_rim, without_crossings
from fd_mitsuba.export.final_surface.slivers import without_slivers
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.export.final_surface.unfolding import unfolded

_SHORTEST_CELLS = 0.2
"""Shorter edges than this, in cells of the training, show nothing more: the field's own cells are twice a cell."""
_MESHED = 0.9
"""Share of the budget that is aimed at: how many faces come out is known only afterwards."""
_THINNED, _WORTH_THINNING = 1.4, 1.3
"""How many times the triangles aimed at remeshing starts from, and how many times more there must be for that."""
_TRIES = 3
"""Times that the edge is lengthened if there are still more faces than wanted."""
_ROUNDS, _RIM_ROUNDS = 4, 3
_LEAST_ANGLE_DEG = 12.0
_LEAST_AT_RIM_DEG = 6.0
_MAY_MOVE_CELLS = 0.05
"""How far from where it was the surface may be for the sake of better triangles, in cells of the training."""
_REFINEMENTS = 2
_OFF_CELLS = 0.07
"""Where an edge's middle is farther from the zero set, in cells of the training, the edge is halved: as in creases."""
_FAR_SHORTER, _MOST_HALVED = 0.5, 0.03
"""Unless it is shorter than this share of the others; and not more at once than this share of the triangles."""


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

    vertices, triangles = _thinned(vertices, triangles, round(_THINNED * _MESHED * faces))
    vertices, triangles = remeshed(vertices, triangles, edge, _ROUNDS)
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
    return _closely(function, near, triangles, edge, faces, step)


def _thinned(vertices: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with its shortest edges collapsed until about `count` triangles are left, if those are clearly fewer.

    A marched surface has five times as many as are wanted; remeshing would take longer over these than over the rest.
    """
    if len(triangles) < _WORTH_THINNING * count:
        return vertices, triangles
    made = igl.decimate(np.ascontiguousarray(vertices), np.ascontiguousarray(triangles, np.int64), count)
    fewer, left = np.asarray(made[0], dtype=np.float64), np.asarray(made[1], dtype=np.int64)
    try:
        edges_of(left, len(fewer))
    except ValueError:
        return vertices, triangles
    return fewer, left


def _closely(
    function: PartFunction, vertices: np.ndarray, triangles: np.ndarray, edge: float, faces: int, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh with every vertex on the zero set, edges whose middles are off it halved, and without slivers.

    Edges are halved only as long as that leaves at most `faces` triangles.
    """
    cell = function.grid.spacing

    def onto(vertices: np.ndarray, triangles: np.ndarray, moved: np.ndarray) -> np.ndarray:
        tried = vertices.copy()
        tried[moved] = project(function.with_gradient, vertices[moved], step, 12, 1e-4 * cell)[0]
        return unfolded(vertices, tried, triangles, np.minimum(smallest_angles(vertices, triangles), _LEAST_ANGLE_DEG))

    vertices = onto(vertices, triangles, np.ones(len(vertices), dtype=bool))
    for number in range(_REFINEMENTS + 1):
        vertices, triangles, moved = without_slivers(vertices, triangles, _LEAST_ANGLE_DEG, _MAY_MOVE_CELLS * cell)
        vertices = onto(vertices, triangles, moved)
        if number == _REFINEMENTS:
            break
        edges = edges_of(triangles, len(vertices))
        middles = vertices[edges.ends].mean(axis=1)
        lengths = np.linalg.norm(vertices[edges.ends[:, 0]] - vertices[edges.ends[:, 1]], axis=1)
        doubtful = np.abs(function.values(middles)) > FLATTEST * _OFF_CELLS * cell
        tried_at = np.flatnonzero(doubtful & (lengths > _FAR_SHORTER * edge))
        off = function.distance(middles[tried_at])
        room = min((faces - len(triangles)) // 2, int(_MOST_HALVED * len(triangles)))
        worst = np.argsort(-off, kind="stable")[: max(room, 0)]
        worst = worst[off[worst] > _OFF_CELLS * cell]
        if not len(worst):
            break
        long = np.zeros(len(edges.ends), dtype=bool)
        long[tried_at[worst]] = True
        count = len(vertices)
        vertices, triangles = halved(vertices, triangles, edges, long)
        vertices = onto(vertices, triangles, np.arange(len(vertices)) >= count)
    return vertices, triangles, function.distance(vertices)
