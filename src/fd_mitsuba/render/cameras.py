"""Pinhole cameras of a whole batch inside one Dr.Jit wavefront: film to ray, and point to film.

Film coordinates are pixels: x to the right, y downwards, (0, 0) the picture's top left corner. Depth is the distance
along the viewing axis, positive in front of the camera. Nothing here is differentiable in the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.upload import upload_doubles, upload_floats
from fd_mitsuba.scene.views import CameraBatch


@dataclass(frozen=True)
class FilmCamera:
    """One camera a lane: axes, position, and half the film's width at depth 1."""

    right: mi.Vector3f
    up: mi.Vector3f
    back: mi.Vector3f
    position: mi.Point3f
    half_width: mi.Float
    size: int

    def ray(self, film: mi.Point2f) -> mi.Ray3f:
        """The ray through a film point; its parameter t is the depth (the direction is not of unit length)."""
        slope = self.slope(film)
        return mi.Ray3f(self.position, slope.x * self.right + slope.y * self.up - self.back)

    def slope(self, film: mi.Point2f) -> mi.Vector2f:
        """How far to the right, and upwards, a film point's ray goes for one unit of depth."""
        x = (film.x * (2.0 / self.size) - 1.0) * self.half_width
        y = (1.0 - film.y * (2.0 / self.size)) * self.half_width
        return mi.Vector2f(x, y)

    def from_eye(self, point: mi.Point3f) -> mi.Vector3f:
        """A point as seen from this camera: to the right, upwards, depth."""
        offset = point - self.position
        return mi.Vector3f(dr.dot(self.right, offset), dr.dot(self.up, offset), -dr.dot(self.back, offset))

    def film(self, point: mi.Point3f) -> mi.Point2f:
        """Where a point in front of the camera lies on the film; differentiable in the point."""
        offset = point - self.position
        scale = 0.5 * self.size / (-dr.dot(self.back, offset) * self.half_width)
        centre = 0.5 * self.size
        return mi.Point2f(centre + dr.dot(self.right, offset) * scale, centre - dr.dot(self.up, offset) * scale)

    def to_camera_space(self, vector: mi.Vector3f) -> mi.Vector3f:
        """A direction of the canonical frame, seen by this camera: x right, y up, z to the viewer."""
        return mi.Vector3f(dr.dot(self.right, vector), dr.dot(self.up, vector), dr.dot(self.back, vector))


class FilmCameras:
    """A `CameraBatch` for pictures of `size` x `size` pixels, uploaded once per pass."""

    def __init__(self, cameras: CameraBatch, size: int) -> None:
        right, up, back = cameras.basis()
        self.count, self.size = len(cameras), size
        self.axes = np.stack([right, up, back], axis=1).astype(np.float64)
        self.position = np.asarray(cameras.position, dtype=np.float64)
        self.half_width = np.tan(np.radians(cameras.fov_deg.astype(np.float64)) / 2)
        self._vectors = [_upload(v) for v in (right, up, back, cameras.position)]
        self._half_width = upload_floats(self.half_width)
        exact = np.concatenate([self.axes.reshape(self.count, 9), self.position, self.half_width[:, None]], axis=1)
        self._exact = [upload_doubles(column) for column in exact.T]

    def at(self, view: mi.UInt32) -> FilmCamera:
        """The cameras of the given views (B of them are numbered from 0)."""
        right, up, back, position = (dr.gather(mi.Vector3f, v, view) for v in self._vectors)
        return FilmCamera(right, up, back, mi.Point3f(position), dr.gather(mi.Float, self._half_width, view), self.size)

    def exactly(self, view: mi.UInt32) -> tuple[mi.Vector3d, mi.Vector3d, mi.Vector3d, mi.Vector3d, mi.Float64]:
        """Right, up, back, position and half the film's width at depth 1 of the given views, in double precision."""
        values = [dr.gather(mi.Float64, column, view) for column in self._exact]
        return (*(mi.Vector3d(*values[k : k + 3]) for k in (0, 3, 6, 9)), values[12])


def _upload(vectors: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(*(upload_floats(vectors[:, axis]) for axis in range(3)))
