"""What a camera sees at a surface point, as a function of the mesh that Dr.Jit can differentiate."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from fd_mitsuba.conventions import NormalSpace
from fd_mitsuba.render.cameras import FilmCamera
from fd_mitsuba.render.mesh_tracer import Hit


@dataclass(frozen=True)
class ShadedMesh:
    """A mesh in Dr.Jit: positions, part weights and normals may carry gradients."""

    vertices: mi.Float
    """(3 V) x, y, z of each vertex."""
    faces: mi.UInt32
    """(3 F)."""
    part_weight: mi.Float
    """(V) in [0, 1]."""
    normals: mi.Float
    """(3 V) x, y, z of each vertex' unit normal."""

    def corners(self, face: mi.UInt32, active: mi.Bool) -> mi.Vector3u:
        """Vertex indices of faces."""
        return dr.gather(mi.Vector3u, self.faces, face, active)

    def positions(self, vertex: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        """Positions of vertices, attached."""
        return dr.gather(mi.Point3f, self.vertices, vertex, active)

    def blend(self, indices: list[mi.UInt32], weights: list[mi.Float], active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """Unit normal and part weight, interpolated between vertices."""
        normal, part = mi.Vector3f(0), mi.Float(0)
        for index, weight in zip(indices, weights, strict=True):
            normal += weight * dr.gather(mi.Vector3f, self.normals, index, active)
            part += weight * dr.gather(mi.Float, self.part_weight, index, active)
        return normal * dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12)), part


def shade_hit(mesh: ShadedMesh, ray: mi.Ray3f, hit: Hit, camera: FilmCamera, space: NormalSpace) -> list[mi.Float]:
    """The five channels of a geometry picture where a fixed ray meets a moving mesh; zeros where it meets nothing.

    The ray stays and the triangle moves beneath it, so the barycentric weights carry gradients too. The mask does not:
    its derivative lies on the silhouette only.
    """
    triangle = mesh.corners(hit.face, hit.seen)
    a, b, c = (mesh.positions(triangle[k], hit.seen) for k in range(3))
    u, v = _barycentric(ray, a, b, c)
    u, v = dr.replace_grad(hit.uv.x, u), dr.replace_grad(hit.uv.y, v)
    normal, part = mesh.blend([triangle.x, triangle.y, triangle.z], [1 - u - v, u, v], hit.seen)
    return channels(normal, part, hit.seen, camera, space)


def channels(
    normal: mi.Vector3f, part: mi.Float, seen: mi.Bool, camera: FilmCamera, space: NormalSpace
) -> list[mi.Float]:
    """Normal x, y, z, object mask and part mask, in the order of `conventions.GEOMETRY_CHANNELS`."""
    shown = camera.to_camera_space(normal) if space == "camera" else normal
    values = [shown.x, shown.y, shown.z, mi.Float(1), part]
    return [dr.select(seen, value, 0) for value in values]


def _barycentric(ray: mi.Ray3f, a: mi.Point3f, b: mi.Point3f, c: mi.Point3f) -> tuple[mi.Float, mi.Float]:
    """Weights of b and c where the ray cuts the triangle's plane; constant 0 where it runs along the plane."""
    edge_b, edge_c, start = b - a, c - a, ray.o - a
    across = dr.cross(ray.d, edge_c)
    volume = dr.dot(edge_b, across)
    usable = dr.abs(volume) > 1e-14
    inverse = dr.select(usable, dr.rcp(dr.select(usable, volume, 1)), 0)
    return dr.dot(start, across) * inverse, dr.dot(ray.d, dr.cross(start, edge_b)) * inverse
