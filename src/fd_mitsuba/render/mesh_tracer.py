"""Which triangle a ray sees, for a mesh whose topology changes at every step.

Building the ray-tracing hierarchy could cost more than everything else in a pass, so

* the faces that stay the same from step to step lie in a scene of their own that is built once; a ray is traced through
  both scenes and the nearer hit wins;
* the other faces are drawn one by one where the rays are those of not too many film points (`see`, `face_raster`), so
  that no hierarchy is needed, except for the few that cover much of a picture or reach behind the camera;
* for other rays (`trace`) they lie in a shape group with one instance. Mitsuba builds the hierarchy of a scene with
  spatial splits, 2.7 microseconds a face, and that of a group without, 0.5 microseconds; rays take the same time and
  see the same.

The scenes are updated in place: one that is loaded anew at every step leaks. On a card OptiX builds hierarchies itself,
and nothing is drawn: all rays are traced, and no shape group is needed.

    face number   0 . . . . . static_faces | . . . . . . . . . . . . . . . . . F
    scene         `_static`, built once    | `_moving`, built when `trace` asks; or none of it (drawn), and
                                           | `_large`: those few of them that are too large to draw
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.startup import FACES, VERTICES, renders_on_card
from fd_mitsuba.backend.upload import upload_floats, upload_indices
from fd_mitsuba.render.cameras import FilmCamera, FilmCameras
from fd_mitsuba.render.face_raster import edge_planes, nearest_faces, sort_points

_POINTS_PER_FACE = 6
"""Up to so many film points for each changing face, faces are drawn.

Pictures of 64 pixels have 3 on the default grid, 1 on a finer one. With 22, as in pictures of 256 pixels, a hierarchy
and its rays took two thirds of the time of drawing; with 6, nearly as long.
"""


@dataclass(frozen=True)
class Hit:
    """What a ray saw first; detached and evaluated."""

    seen: mi.Bool
    face: mi.UInt32
    """Index in the whole face list; 0 where nothing was seen."""
    uv: mi.Point2f
    """Barycentric weights of the triangle's second and third vertex."""
    depth: mi.Float
    """The ray's parameter; infinite where nothing was seen."""

    def part(self, begin: int, end: int) -> Hit:
        """The hits of some of the rays."""
        index = dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, begin)
        seen, face, depth = (dr.gather(type(a), a, index) for a in (self.seen, self.face, self.depth))
        return Hit(seen, face, dr.gather(mi.Point2f, self.uv, index), depth)


class MeshTracer:
    """Updatable scenes of the first `static_faces` faces, of the rest (once somebody asks), and of its large ones."""

    def __init__(self) -> None:
        self._static = _UpdatableScene(quick_build=False)
        quick = not renders_on_card()
        self._moving, self._large = _UpdatableScene(quick_build=quick), _UpdatableScene(quick_build=quick)
        self._static_key: tuple[np.ndarray, np.ndarray] | None = None
        self._static_faces = mi.UInt32(0)
        self._moving_mesh = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
        self._moving_is_built, self._large_faces, self._large_index = True, 0, _at_least_two(np.zeros(0))
        self.static_builds = 0
        """How often the static part was built: 1 as long as the caller's promise holds."""

    def set_mesh(self, vertices: np.ndarray, faces: np.ndarray, static_faces: int = 0) -> None:
        """Makes (V, 3) float32 vertices and (F, 3) faces the mesh to be seen. Indices must be valid: nobody checks.

        The static part is compared with the one before and rebuilt if it differs, so a broken promise costs time only.
        """
        fixed, moving = faces[:static_faces], faces[static_faces:]
        used = vertices[: int(fixed.max()) + 1] if static_faces else vertices[:0]
        if self._static_key is None or not _same(self._static_key, (used, fixed)):
            self._static_key = (used.copy(), fixed.copy())
            self._static.set_mesh(used, fixed)
            self.static_builds += 1
        self._moving_mesh, self._moving_is_built = (vertices, moving), False
        self._static_faces = dr.opaque(mi.UInt32, static_faces)

    def trace(self, ray: mi.Ray3f, coherent: bool, active: mi.Bool | bool = True) -> Hit:
        """The nearest faces along rays, evaluated: later changes of the mesh do not reach the result."""
        if not self._moving_is_built:
            self._moving.set_mesh(*self._moving_mesh)
            self._moving_is_built = True
        with dr.suspend_grad():
            moving = self._moving.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
            face = moving.prim_index + self._static_faces
            return self._before_static(ray, coherent, active, Hit(moving.is_valid(), face, moving.prim_uv, moving.t))

    def see(
        self,
        cameras: FilmCameras,
        film: mi.Point2f,
        view: mi.UInt32,
        mesh: tuple[mi.Float, mi.UInt32],
        from_outside: bool = False,
    ) -> Hit:
        """The same for the rays of film points, drawn or traced, whichever is likely to be sooner; evaluated.

        Args:
            cameras: the views.
            film: (P) points, in pixels; best if neighbours on the film are neighbours here.
            view: (P).
            mesh: flat vertices and faces of the mesh that was set, in Dr.Jit, detached.
            from_outside: whether the mesh is closed and no camera within it, so that no ray meets a face's back first.
        """
        with dr.suspend_grad():
            dr.eval(film, view)
            if renders_on_card() or dr.width(view) > _POINTS_PER_FACE * len(self._moving_mesh[1]):
                return self.trace(cameras.at(view).ray(film), coherent=True)
        return self.draw(cameras, film, view, mesh, from_outside)

    def draw(
        self,
        cameras: FilmCameras,
        film: mi.Point2f,
        view: mi.UInt32,
        mesh: tuple[mi.Float, mi.UInt32],
        from_outside: bool = False,
    ) -> Hit:
        """`see` without a hierarchy of the faces that change, of which there must be one at least."""
        with dr.suspend_grad():
            dr.eval(film, view)
            count = len(self._moving_mesh[1])
            points = sort_points(cameras, film, view)
            drawn = nearest_faces(points, cameras, *mesh, self._static_faces, count, front_only=from_outside)
            self._set_large(np.array(drawn.large))
            camera = cameras.at(view)
            ray = camera.ray(film)
            face = drawn.face + self._static_faces
            uv = _weights(camera, film, face, drawn.seen, *mesh)
            nearer = mi.Ray3f(ray)
            nearer.maxt = drawn.depth
            large = self._large.scene.ray_intersect_preliminary(nearer, coherent=True)
            is_large = large.is_valid()
            large_face = dr.gather(mi.UInt32, self._large_index, large.prim_index, is_large) + self._static_faces
            found = Hit(
                drawn.seen | is_large,
                dr.select(is_large, large_face, face),
                dr.select(is_large, large.prim_uv, uv),
                dr.select(is_large, large.t, drawn.depth),
            )
            return self._before_static(ray, True, True, found)

    def _before_static(self, ray: mi.Ray3f, coherent: bool, active: mi.Bool | bool, moving: Hit) -> Hit:
        """The nearer of given hits and those of the static faces; evaluated."""
        nearer = mi.Ray3f(ray)
        nearer.maxt = dr.minimum(ray.maxt, moving.depth)  # the search ends where the first one hit
        fixed = self._static.scene.ray_intersect_preliminary(nearer, coherent=coherent, active=active)
        is_static = fixed.is_valid()
        seen = is_static | moving.seen
        face = dr.select(is_static, fixed.prim_index, moving.face)
        hit = Hit(
            seen,
            dr.select(seen, face, 0),
            dr.select(is_static, fixed.prim_uv, moving.uv),
            dr.select(is_static, fixed.t, moving.depth),
        )
        dr.eval(hit.seen, hit.face, hit.uv, hit.depth)
        return hit

    def _set_large(self, faces: np.ndarray) -> None:
        """Puts some of the moving faces in the scene for large ones; mostly there are none, before and after."""
        if not len(faces) and not self._large_faces:
            return
        vertices, moving = self._moving_mesh
        self._large.set_mesh(vertices, moving[faces])
        self._large_faces = len(faces)
        self._large_index = _at_least_two(faces)


def _weights(
    camera: FilmCamera, film: mi.Point2f, face: mi.UInt32, seen: mi.Bool, vertices: mi.Float, faces: mi.UInt32
) -> mi.Point2f:
    """The weights of a face's second and third vertex where a film point's ray meets it."""
    triangle = dr.gather(mi.Vector3u, faces, face, seen)
    planes = edge_planes(*(camera.from_eye(dr.gather(mi.Point3f, vertices, triangle[k], seen)) for k in range(3)))
    slope = camera.slope(film)
    a, b, c = (dr.fma(slope.x, plane.x, dr.fma(slope.y, plane.y, plane.z)) for plane in planes)
    inverse = dr.select(seen, dr.rcp(a + b + c), 0)
    return mi.Point2f(b * inverse, c * inverse)


def _at_least_two(numbers: np.ndarray) -> mi.UInt32:
    """Dr.Jit compiles other kernels for an array of one."""
    return upload_indices(np.append(numbers, (0, 0)))


class _UpdatableScene:
    """One scene with one mesh, which starts as an invisible triangle and goes back to it where there are no faces.

    Args:
        quick_build: for meshes that change often.
    """

    def __init__(self, quick_build: bool) -> None:
        mesh = mi.Mesh("mesh", vertex_count=3, face_count=1)
        parameters = mi.traverse(mesh)
        parameters[VERTICES] = mi.Float([0.0] * 9)
        parameters[FACES] = mi.UInt32([0, 1, 2])
        parameters.update()
        content = {"mesh": mesh}
        if quick_build:
            reference = {"type": "ref", "id": "group"}
            content = {
                "group": {"type": "shapegroup", "mesh": mesh},
                "instance": {"type": "instance", "shapegroup": reference},
            }
        self.scene = mi.load_dict({"type": "scene", **content}, optimize=False)
        self._parameters = mi.traverse(self.scene)
        self._prefix = "group.mesh" if quick_build else "mesh"

    def set_mesh(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        if not len(faces):
            vertices, faces = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]])
        # One update for both: Embree crashes when it sees new vertices with stale faces.
        self._parameters[f"{self._prefix}.{VERTICES}"] = upload_floats(vertices)
        self._parameters[f"{self._prefix}.{FACES}"] = upload_indices(faces)
        self._parameters.update()


def _same(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
