"""The plain Mitsuba scene on disk: `scene.xml`, what it reads, and which of its shapes are parts."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.cut_shapes import CutBase
from fd_mitsuba.export.mitsuba_xml import FILES, MitsubaPart, mitsuba_scene
from fd_mitsuba.export.ready_part import ReadyPart
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.part_stack import RECORD_NAME, StackedPart, stack_bytes


def write_mitsuba(
    scene: EditScene,
    inputs: EditInputs,
    parts: list[ReadyPart],
    write: Callable[[str, bytes], None],
    cut: CutBase | None,
    states: Mapping[str, StackedPart],
    settings: dict[str, Any],
    corrected: Mapping[int, bytes],
) -> None:
    """Write `mitsuba/scene.xml`, what it reads, and `mitsuba/stack.json`.

    Args:
        parts: without those that are left out; or the faces of the cut, where they have learned materials.
        write: takes a file's name and bytes.
        cut: the base after a cut.
        states: what is said so far of parts that are left out.
        settings: how this was exported, for the record.
        corrected: number of a base shape -> the PLY to put in the place of a file that Mitsuba would misread.

    Raises:
        UserError: a file of the scene that is gone.
    """
    opened = cut is not None and bool(parts)  # the faces of the cut are meshes of their own
    plain = []
    for part in parts:
        textures = {
            parameter: (part.pictures[key].file_name, key == "base_color") for key, parameter in part.feeds.items()
        }
        bent = part.pictures.get("normal_mitsuba")
        plain.append(MitsubaPart(part.label, f"{part.label}.ply", textures, bent.file_name if bent is not None else ""))
    replaced: dict[int, str | None] = {number: f"corrected_{number}.ply" for number in corrected}
    replaced |= {} if cut is None else cut.names(opened)
    data, copies = mitsuba_scene(
        scene,
        inputs,
        plain,
        replaced,
        [part.shape for part in scene.earlier if part.name in states],
    )
    for name, mesh in cut.files(opened).items() if cut is not None else ():
        write(f"mitsuba/{FILES}/{name}", mesh)
    for number, mesh in corrected.items():
        if (name := f"corrected_{number}.ply") == replaced[number]:
            write(f"mitsuba/{FILES}/{name}", mesh)
    normals = {part.name: part.normal_path(scene.path.parent) for part in scene.earlier if part.name not in states}
    copies |= {path.name: path for path in normals.values() if path is not None}
    for name, source in copies.items():
        try:
            write(f"mitsuba/{FILES}/{name}", source.read_bytes())
        except OSError as error:
            raise UserError(f"{source}: cannot be read any more ({error.strerror}); put the file back") from None
    for part, entry in zip(parts, plain, strict=True):
        write(f"mitsuba/{FILES}/{entry.ply}", part.ply())
        used = {name for name, _ in entry.textures.values()} | {entry.normal_map}
        if "normal" in part.pictures:
            used.add(part.pictures["normal"].file_name)
        for picture in part.pictures.values():
            if picture.file_name in used:
                write(f"mitsuba/{FILES}/{picture.file_name}", picture.data)
    write("mitsuba/scene.xml", data)
    stack = _stack(scene, data, parts, normals, states)
    write(f"mitsuba/{RECORD_NAME}", stack_bytes(stack, settings))


def _stack(
    scene: EditScene,
    data: bytes,
    parts: list[ReadyPart],
    normals: Mapping[str, Path | None],
    states: Mapping[str, StackedPart],
) -> list[StackedPart]:
    """Every part of the exported scene, and those that were left out, oldest first."""
    read = {}
    for shape in ET.fromstring(data).findall("shape"):
        files = [item.get("value", "") for item in shape.iter("string") if item.get("name") == "filename"]
        read[shape.get("id")] = files or [""]
    found = []
    for part in scene.earlier:
        if names := read.get(part.shape):
            normal = normals.get(part.name)
            normal_name = "" if normal is None else f"{FILES}/{normal.name}"
            found.append(replace(part, file=names[0], pictures=tuple(names[1:]), normal=normal_name))
        elif part.name in states:
            found.append(states[part.name])
    latest = 1 + max((part.round for part in scene.earlier), default=0)
    # The faces of a cut are no part: nothing could be hidden, and a next round takes them for base.
    ready = {part.name: part for part in parts if part.label == f"part_{part.name}"}
    for name in scene.parts:
        if name in ready:
            part = ready[name]
            names = read[f"part_{name}"]
            normal = part.pictures.get("normal")
            found.append(
                StackedPart(
                    name,
                    scene.prompt_of(name),
                    latest,
                    len(part.mesh.faces),
                    names[0],
                    tuple(names[1:]),
                    "" if normal is None else f"{FILES}/{normal.file_name}",
                    part.material.base_color,
                )
            )
        elif name in states:
            found.append(states[name])
    return found
