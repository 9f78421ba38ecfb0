"""Which edges of a mesh are its outline: seen from each camera, one face is turned to it and the other away."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.mesh_edges import NO_FACE, EdgeCache, MeshEdges, check_welded, corners
from fd_mitsuba.render.outline import Outline, clip_outline
from fd_mitsuba.render.upload import upload_floats, upload_indices

_VIEWS_AT_ONCE = 32
"""Bits of the number in which a face notes the views that it is turned to."""


class SilhouetteFinder:
    """Finds outlines of meshes whose topology changes; edges of faces that stay the same are kept."""

    def __init__(self) -> None:
        self._cache = EdgeCache()
        self._fixed: tuple[MeshEdges, mi.UInt32, mi.UInt32] | None = None

    def outline(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        cameras: FilmCameras,
        static_faces: int = 0,
        uploaded: tuple[mi.Float, mi.UInt32] | None = None,
    ) -> Outline:
        """The silhouette edges of all views, within the picture. Concave folds are left out: the surface hides them.

        Args:
            vertices: (V, 3) float32.
            faces: (F, 3) int64, welded, outward winding.
            uploaded: flat vertices and faces in Dr.Jit, detached, where the caller has them already.

        Raises:
            ValueError: vertices not welded, or winding not consistent.
        """
        fixed, moving = self._cache.edges(faces, static_faces)
        check_welded(faces, moving)
        if self._fixed is None or self._fixed[0] is not fixed:
            self._fixed = (fixed, upload_indices(fixed.face_a), upload_indices(fixed.face_b))
        edge_sets = (self._fixed, (moving, upload_indices(moving.face_a), upload_indices(moving.face_b)))
        if uploaded is None:
            uploaded = (upload_floats(vertices), upload_indices(faces))
        parts = []
        for begin in range(0, cameras.count, _VIEWS_AT_ONCE):
            eyes = cameras.position[begin : begin + _VIEWS_AT_ONCE]
            facing = _facing(*uploaded, eyes)
            for edges, face_a, face_b in edge_sets:
                if len(edges.half_a):
                    edge, view = _turning(facing, face_a, face_b, len(eyes))
                    parts.append((view + begin, edges.half_a[edge], edges.half_b[edge]))
        if not parts:
            parts.append((np.zeros(0, np.int64),) * 3)
        view, half_a, half_b = (np.concatenate(column) for column in zip(*parts, strict=True))
        return clip_outline(*_convex(vertices, faces, view, half_a, half_b), vertices, cameras)


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


def _turning(facing: mi.UInt32, face_a: mi.UInt32, face_b: mi.UInt32, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Edge and view of all edges that are a boundary, or lie between a face turned to the eye and one turned away."""
    first, second = dr.gather(mi.UInt32, facing, face_a), mi.UInt32(0xFFFFFFFF)
    closed = face_b != NO_FACE
    differ = dr.select(closed, first ^ dr.gather(mi.UInt32, facing, face_b, closed), second)
    differ &= mi.UInt32((1 << views) - 1)
    dr.eval(differ)
    lanes = dr.compress(differ != 0)
    bits = np.array(dr.gather(mi.UInt32, differ, lanes))
    place, view = np.nonzero((bits[:, None] >> np.arange(views, dtype=np.uint32)) & 1)
    return np.array(lanes).astype(np.int64)[place], view


def _convex(
    vertices: np.ndarray, faces: np.ndarray, view: np.ndarray, half_a: np.ndarray, half_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """View, vertices (S, 2) and the opposite vertex of one face, for edges that do not bend inwards."""
    start, end, opposite = corners(faces, half_a)
    _, _, other = corners(faces, np.maximum(half_b, 0))
    begin = vertices[start].T.astype(np.float64)
    along, a, b = (vertices[index].T - begin for index in (end, opposite, other))
    bend = sum((along[k - 2] * a[k - 1] - along[k - 1] * a[k - 2]) * b[k] for k in range(3))
    keep = np.flatnonzero((half_b < 0) | (bend < 0))
    return view[keep], np.stack([start[keep], end[keep]], axis=1), opposite[keep]
