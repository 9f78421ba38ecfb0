"""Where points of space lie in the pictures of several cameras, and which of them a mesh hides."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Bool, Float

from fd_mitsuba.backend.upload import upload_floats
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.mesh_tracer import MeshTracer
from fd_mitsuba.scene.views import CameraBatch

_LIFT = 1e-3
"""A point so little behind a surface, as a share of its depth, counts as on it."""


@dataclass(frozen=True)
class PointViews:
    """Attributes:
    film: (B, N, 2) pixels, x to the right, y downwards from the picture's top left corner.
    seen: (B, N) whether the point is within the picture and nothing of the mesh is before it.
    """

    film: Float[np.ndarray, "B N 2"]
    seen: Bool[np.ndarray, "B N"]


def point_views(
    vertices: np.ndarray, faces: np.ndarray, cameras: CameraBatch, size: int, points: Float[np.ndarray, "N 3"]
) -> PointViews:
    """Points (N, 3) before and behind a mesh, in pictures of `size` x `size` pixels; no gradients.

    Args:
        vertices: (V, 3); faces: (F, 3).
        cameras: B of them, all points in front of each.
    """
    tracer, count = MeshTracer(), len(points)
    tracer.set_mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int64))
    view = dr.arange(mi.UInt32, len(cameras) * count) // dr.opaque(mi.UInt32, count)
    camera = FilmCameras(cameras, size).at(view)
    point = mi.Point3f(*(upload_floats(np.tile(points[:, axis], len(cameras))) for axis in range(3)))
    film, depth = camera.film(point), camera.from_eye(point).z
    hit = tracer.trace(camera.ray(film), coherent=False)
    seen = (hit.depth >= depth * (1 - _LIFT)) & (dr.minimum(film.x, film.y) >= 0) & (dr.maximum(film.x, film.y) < size)
    shape = len(cameras), count
    return PointViews(np.array(film).T.reshape(*shape, 2), np.array(seen).reshape(shape))
