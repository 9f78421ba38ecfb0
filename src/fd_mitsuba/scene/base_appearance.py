"""The base's own material at points of its surface: the paper's texture field of the base, read and never learned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.backend.aligned_memory import aligned
from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.backend.startup import FACES, VERTICES
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.bsdf_reading import Reading, read_material
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.plugins import FOCAL_REGION
from fd_mitsuba.scene.scene_file import ready_mitsuba

_LIFT = 0.01
"""How far above a curved shape's triangles, in canonical units, the ray starts that finds the shape itself."""


def base_shapes(scene: EditScene) -> tuple[Any, list[Any]]:
    """The scene as Mitsuba loads it, without regions and sensors, and in it the shapes of `scene.base`, in order."""
    loaded = scene.mitsuba_scene(without=(FOCAL_REGION, "sensor", "integrator"))
    shapes = [shape for shape in loaded.shapes() if not shape.is_emitter()]
    if len(shapes) != len(scene.base):
        raise RuntimeError(f"{len(shapes)} shapes loaded for {len(scene.base)} meshes of the base")
    return loaded, shapes


@dataclass(frozen=True)
class BaseMaterial:
    """The base's material at N points; what a BSDF does not say is 0 here and False in `known`."""

    base_color: Tensor
    """(N, 3) float32, linear."""
    roughness: Tensor
    """(N, 1) as `principled` means it; see `bsdf_reading` for other BSDFs."""
    metallic: Tensor
    """(N, 1)."""
    known: Tensor
    """(N, 5) bool: which of the columns of `style` the base's BSDF there says anything about."""

    def style(self, otherwise: Tensor | None = None) -> Tensor:
        """(N, 5) kd and krm, as `TextureValues.style`; `otherwise` (N, 5), without its gradient, where not known."""
        values = torch.cat([self.base_color, self.roughness, self.metallic], dim=1)
        return values if otherwise is None else torch.where(self.known, values, otherwise.detach())


class BaseAppearance:
    """Looks up the base's material at the nearest point of its surface.

    The base is loaded by Mitsuba as the scene file has it, and the BSDF of the nearest shape is asked at the nearest
    point with that point's UVs, so that bitmaps, their transforms and mesh attributes mean what they mean in a render.

    Args:
        scene: what to edit.

    Attributes:
        unreadable: a sentence for each shape of whose BSDF nothing can be read.

    Raises:
        UserError: the same for the whole base.
    """

    def __init__(self, scene: EditScene) -> None:
        self._mi = ready_mitsuba()
        self._frame = scene.render_frame
        self._scene, shapes = base_shapes(scene)  # the shapes need their scene alive
        self._shapes = shapes
        meshes = [
            self._triangles(shape) if isinstance(shape, self._mi.Mesh) else (mesh.vertices, mesh.faces)
            for shape, mesh in zip(shapes, scene.render_base, strict=True)
        ]
        self._first_face = np.cumsum([0] + [len(faces) for _, faces in meshes])
        first_vertex = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
        self._vertices = np.concatenate([vertices for vertices, _ in meshes])
        self._faces = np.concatenate([faces + first for (_, faces), first in zip(meshes, first_vertex, strict=False)])
        self._distance = MeshDistance(self._vertices, self._faces)
        self.unreadable = tuple(
            f"{scene.path}: base {mesh.name}: its BSDF {shape.bsdf().class_name()} has no base colour, reflectance or "
            "roughness that can be read; style consistency leaves it out"
            for shape, mesh, first in zip(shapes, scene.base, self._first_face, strict=False)
            if not self._read(shape, np.array([first]), np.full((1, 3), 1 / 3), int(first)).says_anything
        )
        if len(self.unreadable) == len(shapes):
            remedy = "use one such as principled, or set appearance.style=false"
            raise UserError(self.unreadable[0].replace("style consistency leaves it out", remedy))

    def distance(self, points: Tensor) -> Tensor:
        """(N,) float32 distance of canonical points (N, 3) to the base's surface, canonical units. No gradient."""
        user = self._frame.to_user(points.detach().numpy())
        return torch.from_numpy(self._distance.unsigned(user) * self._frame.scale).float()

    def lookup(self, points: Tensor) -> BaseMaterial:
        """The material at the surface points of the base nearest to canonical points (N, 3). No gradient."""
        face, weights = self._distance.nearest(self._frame.to_user(points.detach().numpy()))
        count = len(face)
        reading = Reading(np.full((count, 3), np.nan), np.full(count, np.nan), np.full(count, np.nan))
        owner = np.searchsorted(self._first_face, face, side="right") - 1
        for number in np.unique(owner):
            here = owner == number
            first = int(self._first_face[number])
            part = self._read(self._shapes[number], face[here], weights[here], first)
            reading.base_color[here], reading.roughness[here] = part.base_color, part.roughness
            reading.metallic[here] = part.metallic
        values = np.column_stack([reading.base_color, reading.roughness, reading.metallic])
        known = torch.from_numpy(np.isfinite(values))
        filled = torch.from_numpy(np.nan_to_num(values, posinf=0.0, neginf=0.0)).float()
        return BaseMaterial(filled[:, :3], filled[:, 3:4], filled[:, 4:5], known)

    def _triangles(self, shape: Any) -> tuple[np.ndarray, np.ndarray]:
        parameters = self._mi.traverse(shape)
        vertices = np.array(parameters[VERTICES], dtype=np.float64).reshape(-1, 3)
        return vertices, np.array(parameters[FACES]).astype(np.int64).reshape(-1, 3)

    def _read(self, shape: Any, face: np.ndarray, weights: np.ndarray, first_face: int) -> Reading:
        """The material of one shape on triangles `face` (N,) of the whole base at corner weights (N, 3)."""
        import drjit as dr

        mi = self._mi
        is_mesh = isinstance(shape, mi.Mesh)
        if not is_mesh:
            # The rims of the triangles may lie just beside the curved shape.
            weights = 0.999 * weights + 0.001 / 3
        corners = self._vertices[self._faces[face]]
        foot = np.einsum("ij,ijk->ik", weights, corners)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > 0, normal / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        lift = _LIFT / self._frame.scale
        with file_threads():
            ray = mi.Ray3f(_columns(mi, mi.Point3f, foot + lift * normal), _columns(mi, mi.Vector3f, -normal))
            if is_mesh:
                hit = dr.zeros(mi.PreliminaryIntersection3f, len(face))
                hit.t, hit.valid = mi.Float(lift), mi.Bool(True)
                hit.prim_index = mi.UInt32(aligned(face - first_face, np.uint32))
                hit.prim_uv = _columns(mi, mi.Point2f, weights[:, 1:])
                hit.shape = mi.ShapePtr(shape)
            else:
                hit = shape.ray_intersect_preliminary(ray)
            interaction = hit.compute_surface_interaction(ray, mi.RayFlags.All, True)
            return read_material(mi, shape.bsdf(), interaction, len(face))


def _columns(mi: Any, kind: Any, rows: np.ndarray) -> Any:
    return kind(*(mi.Float(aligned(rows[:, i], np.float32)) for i in range(rows.shape[1])))
