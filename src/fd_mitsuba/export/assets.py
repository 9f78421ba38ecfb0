"""Everything that a run hands over to other programs: GLB, OBJ, PLY and a plain Mitsuba scene."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fd_mitsuba import __version__
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.base_shapes import base_shapes
from fd_mitsuba.export.cut_shapes import CutBase
from fd_mitsuba.export.formats import EXPORTERS, FORMATS, ExportContent, Exporter, shape_name
from fd_mitsuba.export.meshes import copy_base
from fd_mitsuba.export.printing import Print
from fd_mitsuba.export.ready_part import PartAsset, ready_part
from fd_mitsuba.export.usd import Usdz
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.part_stack import SHOWN, read_stack
from fd_mitsuba.scene.region_mode import cut_faces_name
from fd_mitsuba.scene.scene_file import SceneElement
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

FURTHER = (Print.leaves, Usdz.leaves)
"""Of formats that are registered by their modules being imported here, after those that are written by default."""


def export_assets(
    scene: EditScene,
    config: RunConfig,
    parts: Mapping[str, PartAsset],
    folder: Path,
    formats: Collection[str | Choice] = FORMATS,
    texture_size: int = 1024,
    say: Callable[[str], None] = lambda line: None,
    cut: CutBase | None = None,
    face_budgets: tuple[int, ...] | None = None,
    stack_below: Path | None = None,
) -> dict[str, Any]:
    """Write the base's files unchanged into `base/`, and the formats asked for; returns what was written.

    `asset.glb`, `obj/asset.obj`, `ply/part_<name>.ply`, `mitsuba/scene.xml`, and with learned materials their
    pictures in `textures/`, as PNG and EXR. Everything is in the user's frame and unit.

    Args:
        parts: name -> part.
        folder: is made if it is missing; files of the same name are replaced.
        formats: names of `EXPORTERS`, or choices with their options.
        texture_size: texels a side of each part's textures.
        say: takes remarks, a line each.
        cut: the base without the parts, where these were removed from it: it is written, in place of base and parts.
            Where the parts have learned materials, these go to the faces of the cut, as meshes of their own.
        face_budgets: that the parts were decimated to, and those of further levels of detail, for the record.
        stack_below: the export folder whose `mitsuba/stack.json` tells which parts are hidden; None: `folder`.

    Parts that `mitsuba/stack.json` in the folder calls hidden or removed are left out of everything.

    Raises:
        UserError: an unknown format or texture size, names that clash, a part without volume, a file of the scene that
            is gone, a folder that cannot be written.
    """
    exporters = chosen_exporters(formats)
    _check(scene, parts, folder, texture_size)
    inputs = scene.inputs
    file = inputs.scene
    states = {part.name: part for part in read_stack((stack_below or folder) / "mitsuba")[0] if part.state != SHOWN}
    absent = {part.shape for part in scene.earlier if part.name in states}
    textured = cut is not None and any(part.values is not None for part in parts.values())
    whole = base_shapes(scene, file) if cut is None else cut.opened if textured else cut.shapes
    shapes = [shape for shape in whole if shape is not None and shape.name not in absent]
    kept = replace(scene, base=tuple(mesh for mesh in scene.base if mesh.name not in absent))
    identical = copy_base(kept, folder / BASE_NAME, _base_textures(scene, absent))
    if cut is None:
        added = {f"part_{name}": (name, part) for name, part in parts.items() if name not in states}
    else:
        added = {cut_faces_name(name): (name, part) for name, part in _cut_faces(cut, parts).items()}
    ready = [
        ready_part(scene, config, inputs, name, label, part, folder, texture_size, say)
        for label, (name, part) in added.items()
    ]
    notes = {item.material.name: list(item.material.notes) for item in [*shapes, *ready] if item.material.notes}
    extras = {"prompt": scene.prompt, "seed": config.seed, "version": __version__, "unit": "as in the scene file"}
    written: list[str] = []

    def write(name: str, data: bytes) -> None:
        write_atomically(folder / name, data)
        written.append(name)

    corrected = {i: shape.corrected for i, shape in enumerate(whole) if shape is not None and shape.corrected}
    record: dict[str, Any] = {"texture_size": texture_size, "faces": None}
    if face_budgets:
        record["faces"], record["levels"] = face_budgets[0], list(face_budgets[1:])
    if scene.surroundings:
        record["surroundings"] = scene.surroundings_ids
    if scene.unit is not None:  # the exported scene has no `dual_path` that could say it
        record["unit"] = scene.unit
    content = ExportContent(scene, inputs, shapes, ready, cut, extras, states, record, corrected, write, say)
    for exporter in exporters:
        exporter.write(content)
    return {
        "files": written,
        "base_identical": identical,
        "part_faces": {part.name: len(part.mesh.faces) for part in ready},
        "notes": notes,
        "shading_noise_deg": {part.name: part.noise_deg for part in ready if part.noise_deg is not None},
    }


def chosen_exporters(formats: Collection[str | Choice]) -> list[Exporter]:
    """The exporters of formats: built-in ones in their own order, then others in that given.

    Raises:
        UserError: an unknown format, or wrong options.
    """
    choices = [Choice.of(item) if isinstance(item, str) else item for item in formats]
    wanted = {choice.kind: choice for choice in choices}
    names = [*(name for name in FORMATS if name in wanted), *(name for name in wanted if name not in FORMATS)]
    return [EXPORTERS.make(wanted[name], "--format") for name in names]


def _check(scene: EditScene, parts: Mapping[str, PartAsset], folder: Path, texture_size: int) -> None:
    if not 16 <= texture_size <= 8192:
        raise UserError(f"--texture-size {texture_size}: give a number from 16 to 8192")
    if not parts:
        raise UserError(f"{scene.path}: no part to export; add a focal region")
    taken = {shape_name(scene, mesh.name).lower(): mesh.name for mesh in scene.base}
    taken[BASE_NAME] = "the base"
    for name, part in parts.items():
        # File systems and programs that take A for a are common.
        for wanted in {name.lower(), f"part_{name}".lower()}:
            if wanted in taken:
                raise UserError(f"{scene.path}: part {name!r} has the name of {taken[wanted]}; rename one of them")
        taken |= {name.lower(): name, f"part_{name}".lower(): name}
        volume = TriangleMesh(name, part.vertices, part.faces).volume() if len(part.faces) else 0.0
        if not volume > 0:
            raise UserError(f"{folder}: part {name!r} has no volume to export; run more steps, or enlarge its region")
    probe = folder / ".writable.tmp"
    write_atomically(probe, b"")
    probe.unlink(missing_ok=True)


def _cut_faces(cut: CutBase, parts: Mapping[str, PartAsset]) -> dict[str, PartAsset]:
    """The faces of the cut of every part that has a learned material."""
    return {
        name: PartAsset(mesh.vertices, mesh.faces, parts[name].values)
        for name, mesh in cut.faces.items()
        if parts[name].values is not None
    }


def _base_textures(scene: EditScene, absent: Collection[str]) -> list[Path]:
    """Picture files that the materials of the base read, without those of shapes with the ids `absent`."""
    found: dict[Path, None] = {}
    file = scene.inputs.scene

    def visit(element: SceneElement) -> None:
        for index in element.children.values():
            child = file.elements[index]
            name = child.properties.get("filename")
            if child.kind == "texture" and isinstance(name, str):
                found[file.resolve(name)] = None
            visit(child)

    for element in scene.base_elements:
        if element.id not in absent:
            visit(element)
    return list(found)
