"""The entries of `--format`: what a run's result can be written as. A class each, which gets everything ready-made."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from fd_mitsuba.config.registry import Registry
from fd_mitsuba.config.section import Section
from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.export.bake.tangents import vertex_tangents
from fd_mitsuba.export.base_shapes import BaseShape
from fd_mitsuba.export.cut_shapes import CutBase
from fd_mitsuba.export.gltf import GltfMesh, glb_bytes, is_placement
from fd_mitsuba.export.mitsuba_files import write_mitsuba
from fd_mitsuba.export.obj import ObjMesh, obj_files
from fd_mitsuba.export.part_record import anchor
from fd_mitsuba.export.ready_part import ReadyPart
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.io.safe_text import safe_name
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.part_stack import StackedPart


@dataclass(frozen=True)
class ExportContent:
    """What an exporter gets; meshes in the user's frame and unit, without parts that are hidden.

    Attributes:
        scene: what was edited.
        inputs: its files, parsed.
        shapes: the base's shapes with their materials; after a cut, what it leaves of them.
        parts: the grown parts with atlas, material and baked textures; after a cut that has learned materials, its
            faces.
        cut: the base after a cut; None: parts were added.
        extras: prompt, seed, version, unit: for the file's header.
        states: what is said so far of parts that are left out.
        record: how this is exported, such as `texture_size`.
        corrected: number of a shape -> the mesh that stands in for one that plain Mitsuba would show otherwise.
        write: takes a path below the export folder, such as `stl/part.stl`, and the file's bytes. It is put there
            whole or not at all, and is listed among what was written.
        say: takes remarks, a line each.
    """

    scene: EditScene
    inputs: EditInputs
    shapes: list[BaseShape]
    parts: list[ReadyPart]
    cut: CutBase | None
    extras: dict[str, Any]
    states: Mapping[str, StackedPart]
    record: dict[str, Any]
    corrected: Mapping[int, bytes]
    write: Callable[[str, bytes], None]
    say: Callable[[str], None] = lambda line: None

    def shape_name(self, shape: str) -> str:
        """What a shape of the base is called in exports."""
        return shape_name(self.scene, shape)


class Exporter(ABC):
    """Writes one format.

    Attributes:
        leaves: a file or folder below the export folder that is there if, and only if, the format was written.
        settings: its own, as the registry has checked them.
    """

    leaves: ClassVar[str]

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @abstractmethod
    def write(self, content: ExportContent) -> None:
        """Hand every file to `content.write`; UserError for what the format cannot hold."""


EXPORTERS: Registry[type[Exporter]] = Registry("exporters", "format")
"""Called with their settings."""


Unit = Literal["mm", "cm", "m"]
METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0}
"""In a unit."""


AS_IT_IS: Literal["as_it_is"] = "as_it_is"
"""In place of a unit: whatever the scene says, its numbers are written as they are."""


class GlbSettings(Section):
    """Of `glb`."""

    unit: Unit | Literal["as_it_is"] | None = None
    """What a unit of the scene is, since glTF has metres: a node `asset` above all others scales by it. Default: what
    the scene's `dual_path` says in `unit`; without that, and with `as_it_is`, numbers are written as they are."""
    pivot: bool = False
    """Whether a part's node lies where the part grows out of the base, so that it turns about its joint."""


@EXPORTERS.register("glb", GlbSettings)
class Glb(Exporter):
    """`asset.glb`: binary glTF 2 with a node a shape and a part."""

    leaves = "asset.glb"

    def write(self, content: ExportContent) -> None:
        unit = self.settings.unit or content.scene.unit
        unit = None if unit == AS_IT_IS else unit
        extras = content.extras if unit is None else {**content.extras, "unit": "metre"}
        meshes = gltf_meshes(content, self.settings.pivot)
        content.write(self.leaves, glb_bytes(meshes, extras, None if unit is None else METRES[unit]))


@EXPORTERS.register("obj")
class Obj(Exporter):
    """`obj/asset.obj` with its MTL and pictures."""

    leaves = "obj/asset.obj"

    def write(self, content: ExportContent) -> None:
        for name, data in obj_files(_obj_meshes(content)).items():
            content.write(f"obj/{name}", data)


@EXPORTERS.register("ply")
class Ply(Exporter):
    """`ply/part_<name>.ply` with normals and UVs; after a cut, what is left of the base's shapes."""

    leaves = "ply"

    def write(self, content: ExportContent) -> None:
        for name, source in _earlier_files(content).items():
            content.write(f"ply/{safe_name(name, suffix='.ply')}", source.read_bytes())
        for part in content.parts:
            content.write(f"ply/{part.label}.ply", part.ply())
        for name, data in content.cut.files().items() if content.cut is not None else ():
            content.write(f"ply/{name}", data)


@EXPORTERS.register("mitsuba")
class Mitsuba(Exporter):
    """`mitsuba/scene.xml`: a plain scene with the part, and what it reads."""

    leaves = "mitsuba/scene.xml"

    def write(self, content: ExportContent) -> None:
        write_mitsuba(
            content.scene,
            content.inputs,
            content.parts,
            content.write,
            content.cut,
            content.states,
            content.record,
            content.corrected,
        )


FORMATS = EXPORTERS.names()
"""The built-in ones, in the order in which they are written."""


def shape_name(scene: EditScene, name: str) -> str:
    """A base mesh's name in the exports: `base`, `base_<name>` where there are several, `part_<name>` of old parts."""
    earlier = {part.shape for part in scene.earlier}
    if name in earlier:
        return name
    return BASE_NAME if len(scene.base) - len(earlier) == 1 else f"{BASE_NAME}_{name}"


def _earlier_files(content: ExportContent) -> dict[str, Path]:
    """Shape -> the PLY of every part of an earlier round that is still what it was."""
    scene, cut = content.scene, content.cut
    earlier = {part.shape for part in scene.earlier if part.name not in content.states}
    changed = (
        {shape.name for shape, is_cut in zip(cut.shapes, cut.is_cut, strict=True) if is_cut and shape} if cut else ()
    )
    files = {mesh.name: mesh.source_files[0] for mesh in scene.base if mesh.name in earlier and mesh.source_files}
    return {name: file for name, file in files.items() if name not in changed and file.suffix == ".ply"}


def gltf_meshes(content: ExportContent, pivot: bool = False) -> list[GltfMesh]:
    """The meshes.

    Args:
        pivot: put each part's node at its joint.
    """
    meshes, origin, away = [], content.scene.origin, np.eye(4)
    away[:3, 3] = origin  # a GLB has 32 bits for positions, and 64 for a node's place
    earlier = {part.shape: part for part in content.scene.earlier}
    for shape in content.shapes:
        vertices, faces, normals, place = shape.vertices, shape.faces, shape.normals, shape.to_world
        if not is_placement(place) or np.linalg.det(place[:3, :3]) < 0:
            vertices, faces, normals = shape.in_user_frame()
            vertices, place = vertices - origin, away
        tangents = None
        if shape.material.normal_picture is not None and normals is not None and shape.uv is not None:
            tangents = vertex_tangents(vertices, faces, normals, shape.uv)
        name = content.shape_name(shape.name)
        parent = "" if name == BASE_NAME or shape.name in earlier else BASE_NAME
        about: dict[str, Any] = {"shape": shape.name}
        if old := earlier.get(shape.name):
            about = {"part": old.name, "prompt": old.prompt, "round": old.round}
        meshes.append(
            GltfMesh(
                name, vertices, faces, shape.material, normals, shape.uv, shape.colours, tangents, place, parent, about
            )
        )
    for part in content.parts:
        mesh = part.mesh
        tangents = vertex_tangents(mesh.vertices, mesh.faces, mesh.normals, mesh.uv)
        about = {**content.extras, "part": part.name, "prompt": content.scene.prompt_of(part.name)}
        place = _joint(content.scene, mesh.vertices, mesh.faces) if pivot else origin
        placed = np.eye(4)
        placed[:3, 3] = place
        meshes.append(
            GltfMesh(
                part.label,
                mesh.vertices - place,
                mesh.faces,
                part.material,
                mesh.normals,
                mesh.uv,
                tangents=tangents,
                to_world=placed,
                extras=about,
            )
        )
    return meshes


def _joint(scene: EditScene, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(3,) where a part grows out of the base, user frame."""
    base = scene.base_canonical
    solid = Solid(scene.frame.to_canonical(vertices), faces)
    return scene.frame.to_user(anchor(solid, base, MeshDistance(base.vertices, base.faces))[0])


def _obj_meshes(content: ExportContent) -> list[ObjMesh]:
    meshes = []
    for shape in content.shapes:
        vertices, faces, normals = shape.in_user_frame()
        name = content.shape_name(shape.name)
        meshes.append(ObjMesh(name, vertices, faces, shape.material, normals, shape.uv, shape.colours))
    for part in content.parts:
        mesh = part.mesh
        meshes.append(ObjMesh(part.label, mesh.vertices, mesh.faces, part.material, mesh.normals, mesh.uv))
    return meshes
