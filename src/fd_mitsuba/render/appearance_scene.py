"""The scene of the appearance stage: base and parts side by side under the scene's own lights, in the user's frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.startup import FACES, VERTICES
from fd_mitsuba.backend.upload import upload_floats, upload_indices
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.errors import UserError
from fd_mitsuba.render.film_extent import hull_corners
from fd_mitsuba.render.part_shading import CHANNELS, PartShading, bounce_shading
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_source import ANALYTIC

_NOT_RENDERED = ("focal_region", "sensor", "integrator")


class Triangles(Protocol):
    """A mesh, canonical frame, outward faces: a closed part, or the faces of a cut."""

    @property
    def vertices(self) -> np.ndarray: ...

    @property
    def faces(self) -> np.ndarray: ...


@dataclass(frozen=True)
class AppearanceScene:
    """Built once per run.

    Attributes:
        lit: everything, for shadows and bounces.
        visible: what a camera sees: shapes that are lights are left out, as by Mitsuba's `hide_emitters`, and so are
            surroundings, which would stand between the camera and the object.
        parts: the parts' meshes, in the order of the names.
        base_shapes: the base's shapes, with their own BSDFs.
    """

    lit: mi.Scene
    visible: mi.Scene
    parts: tuple[mi.Mesh, ...]
    base_shapes: tuple[Any, ...]

    @classmethod
    def build(
        cls,
        scene: EditScene,
        parts: Mapping[str, Triangles],
        shading: PartShading,
        bounces: bool,
        opened: Mapping[int, Path | None] | None = None,
    ) -> AppearanceScene:
        """Load the scene file once more and put the parts into it.

        Args:
            bounces: whether light may go on from a part's surface; if not, nobody asks for its BSDF there.
            opened: number of a base shape -> the mesh that takes its place after a cut, None: nothing does.

        Raises:
            UserError: the scene has no emitter, or an emitter holds values that are not finite.
            ValueError: a part is empty, not finite, or an index is out of range.
        """
        loaded = scene.mitsuba_scene(without=_NOT_RENDERED)
        if not loaded.emitters():
            raise UserError(
                f'{scene.path}: no emitter: nothing would be lit; add <emitter type="envmap"> or another light'
            )
        for emitter in loaded.emitters():
            _check_emitter(scene, emitter)
        meshes = tuple(_part_mesh(name, solid, scene, shading if bounces else None) for name, solid in parts.items())
        lamps = [shape for shape in loaded.shapes() if shape.is_emitter()]
        base = _opened(scene, [shape for shape in loaded.shapes() if not shape.is_emitter()], opened or {})
        # A light with a shape comes along with that shape.
        lights = [light for light in loaded.emitters() if not mi.has_flag(light.flags(), mi.EmitterFlags.Surface)]
        surroundings = scene.mitsuba_surroundings()
        around = surroundings.shapes() if surroundings is not None else []
        lit = _scene([*base, *meshes, *lamps, *around, *lights])
        visible = _scene([*base, *meshes]) if lamps or around else lit
        _keep_at_distance(lights, [*loaded.shapes(), *around], scene)
        return cls(lit, visible, meshes, tuple(base))

    @cached_property
    def corners(self) -> np.ndarray:
        """Points whose convex hull holds all that is visible, (V, 3)."""
        return hull_corners(self.visible)

    def set_vertex_values(self, part: int, values: Mapping[str, np.ndarray]) -> None:
        """What further bounces see on a part: BSDF values, field -> (V, C), one row for each of its vertices."""
        parameters = mi.traverse(self.parts[part])
        for name, value in values.items():
            key = f"vertex_{name}"
            if key not in parameters:
                continue
            if np.size(value) != dr.width(parameters[key]):
                raise ValueError(f"{name}: {np.shape(value)} values do not fit the part's vertices")
            parameters[key] = upload_floats(np.asarray(value))
        parameters.update()


def _scene(objects: list[Any]) -> mi.Scene:
    content = {f"object_{number}": value for number, value in enumerate(objects)}
    return mi.load_dict({"type": "scene", **content}, optimize=False, parallel=False)


def _keep_at_distance(lights: list[Any], shapes: list[Any], scene: EditScene) -> None:
    """Put lights from infinity on a sphere around the scene file's shapes and all that the grid could hold.

    Mitsuba puts them on one around what is in the scene, so that a part would move it. Rays to a light would then
    differ in their last digits, and where the base only just shades itself, pixels would change that the part has
    nothing to do with.
    """
    bounds = mi.ScalarBoundingBox3f()
    for shape in shapes:
        bounds.expand(shape.bbox())
    for corner in scene.render_frame.to_user(GRID_HALF_EXTENT * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])):
        bounds.expand(mi.ScalarPoint3f(*corner))
    middle, reach = np.array(bounds.center()), float(np.linalg.norm(np.array(bounds.extents()))) / 2
    room = _scene([mi.load_dict({"type": "sphere", "center": middle.tolist(), "radius": reach})])
    for light in lights:
        light.set_scene(room)


def _opened(scene: EditScene, shapes: list[Any], opened: Mapping[int, Path | None]) -> list[Any]:
    """The base's shapes, those that were cut with what is left of their triangles; BSDFs and places stay."""
    if not opened:
        return shapes
    left = []
    for number, (shape, element) in enumerate(zip(shapes, scene.base_elements, strict=True)):
        path = opened.get(number)
        if path is None:
            left += [shape] * (number not in opened)
            continue
        description = {"type": "ply", "filename": str(path), "bsdf": shape.bsdf()}
        if element.plugin not in ANALYTIC:  # of these the file is in the user's frame
            names = ("to_world", "face_normals")
            description |= {name: element.properties[name] for name in names if name in element.properties}
        if scene.origin.any():
            matrix = np.array(description.get("to_world", mi.ScalarTransform4d()).matrix, dtype=np.float64)
            matrix[:3, 3] -= scene.origin
            description["to_world"] = mi.ScalarTransform4f(matrix.tolist())
        left.append(mi.load_dict(description, optimize=False))
    return left


def _part_mesh(name: str, solid: Triangles, scene: EditScene, shading: PartShading | None) -> mi.Mesh:
    vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError(f"part {name!r}: {len(vertices)} vertices, {len(faces)} faces: empty, not finite or bad index")
    properties = mi.Properties()
    properties["bsdf"] = bounce_shading(shading) if shading else mi.load_dict({"type": "diffuse"})
    mesh = mi.Mesh(name, len(vertices), len(faces), props=properties, has_vertex_normals=True)
    for field in shading.feeds if shading else ():
        mesh.add_attribute(f"vertex_{field}", CHANNELS[field], [0.5] * (CHANNELS[field] * len(vertices)))
    parameters = mi.traverse(mesh)
    parameters[VERTICES] = upload_floats(scene.render_frame.to_user(vertices))
    parameters[FACES] = upload_indices(faces)
    parameters.update()
    return mesh


def _check_emitter(scene: EditScene, emitter: Any) -> None:
    for name, value in mi.traverse(emitter).items():
        if name.endswith("data") and not bool(dr.all(dr.isfinite(dr.ravel(value)))):
            what = f'emitter "{emitter.id()}"'
            raise UserError(f"{scene.path}: {what}: its picture has pixels that are NaN or infinite; use another one")
