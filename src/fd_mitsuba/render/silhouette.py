"""Which edges of a mesh are its outline: seen from each camera, one face is turned to it and the other away."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.upload import upload_floats
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.mesh_edges import MeshEdges, check_welded, pair_closed, pair_half_edges
from fd_mitsuba.render.outline import Outline, clip_outline, neighbours

_VIEWS_AT_ONCE = 32
"""Bits of the number in which a face notes the views that it is turned to."""


def find_outline(
    faces: np.ndarray, cameras: FilmCameras, uploaded: tuple[mi.Float, mi.UInt32], closed: bool
) -> Outline:
    """The silhouette edges of all views, within the picture. Concave folds are left out: the surface hides them.

    Args:
        faces: (F, 3) int64, welded, outward winding.
        uploaded: flat vertices, and the same faces, in Dr.Jit, detached.
        closed: what `is_closed` says of them; True saves the search for boundaries.

    Raises:
        ValueError: vertices not welded, or winding not consistent.
    """
    positions, triangles = uploaded
    vertices, every = dr.width(positions) // 3, None if closed else pair_half_edges(faces)
    if every is not None:
        check_welded(faces, every)
    parts = [(np.zeros(0, np.int64),) * 3]
    for begin in range(0, cameras.count, _VIEWS_AT_ONCE):
        eyes = cameras.position[begin : begin + _VIEWS_AT_ONCE]
        facing = _facing(positions, triangles, eyes)
        edges = every or pair_closed(faces, *_where_it_turns(facing, triangles, vertices), vertices=vertices)
        edge, view = _turning(np.array(facing), edges, len(eyes))
        parts.append((view + begin, edges.half_a[edge], edges.half_b[edge]))
    view, half_a, half_b = (np.concatenate(column) for column in zip(*parts, strict=True))
    return clip_outline(view, MeshEdges(half_a, half_b), positions, triangles, cameras)


def _count(triangles: mi.UInt32) -> int:
    return dr.width(triangles) // 3


def _facing(positions: mi.Float, triangles: mi.UInt32, eyes: np.ndarray) -> mi.UInt32:
    """One number a face: bit b says whether it is turned to the eye b of at most 32."""
    triangle = dr.gather(mi.Vector3u, triangles, dr.arange(mi.UInt32, dr.width(triangles) // 3))
    a, b, c = (dr.gather(mi.Point3f, positions, triangle[k]) for k in range(3))
    normal = dr.cross(b - a, c - a)
    places = upload_floats(eyes)
    bits = mi.UInt32(0)
    for view in range(len(eyes)):
        eye = dr.gather(mi.Point3f, places, mi.UInt32(view))
        bits |= dr.select(dr.dot(normal, eye - a) > 0, mi.UInt32(1 << view), mi.UInt32(0))
    dr.eval(bits)
    return bits


def _where_it_turns(
    facing: mi.UInt32, triangles: mi.UInt32, vertices: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Half-edges of which both ends have faces turned to an eye and away from it: one in ten; start and end; each (H,).

    In a closed mesh every edge of an outline is among them, with both its half-edges, so nothing else need be paired.
    """
    triangle = dr.gather(mi.Vector3u, triangles, dr.arange(mi.UInt32, _count(triangles)))
    any_face = dr.empty(mi.UInt32, vertices)
    for index in triangle:
        dr.scatter(any_face, facing, index)  # whichever comes last: faces that differ do so from one of them, too
    turns = dr.zeros(mi.UInt32, vertices)
    for index in triangle:
        differ = facing ^ dr.gather(mi.UInt32, any_face, index)
        dr.scatter_reduce(dr.ReduceOp.Or, turns, differ, index, differ != 0)
    a, b, c = (dr.gather(mi.UInt32, turns, index) for index in triangle)
    face = dr.compress(((a & b) | (b & c) | (c & a)) != 0)
    if not dr.width(face):
        nothing = np.zeros(0, np.int32)
        return nothing, nothing, nothing
    lane = dr.arange(mi.UInt32, 3 * dr.width(face))
    half = 3 * dr.gather(mi.UInt32, face, lane // 3) + lane % 3
    start = dr.gather(mi.UInt32, triangles, half)
    end = dr.gather(mi.UInt32, triangles, neighbours(half)[0])
    lanes = dr.compress((dr.gather(mi.UInt32, turns, start) & dr.gather(mi.UInt32, turns, end)) != 0)
    chosen = [dr.gather(mi.UInt32, column, lanes) for column in (half, start, end)]
    dr.eval(chosen)
    half, start, end = (np.array(column).view(np.int32) for column in chosen)
    return half, start, end


def _turning(facing: np.ndarray, edges: MeshEdges, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Edge and view of all edges that are a boundary, or lie between a face turned to the eye and one turned away."""
    differ = facing[edges.half_a // 3] ^ facing[edges.half_b // 3]
    differ[edges.half_b < 0] = 0xFFFFFFFF
    chosen = np.flatnonzero(differ)
    place, view = np.nonzero((differ[chosen, None] >> np.arange(views, dtype=np.uint32)) & 1)
    return chosen[place], view
