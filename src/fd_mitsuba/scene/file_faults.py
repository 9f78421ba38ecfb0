"""Which file of a scene made Mitsuba fail, and why, once it has failed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.backend.parser_message import MITSUBA_ERRORS, remedy_for
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.mesh_diagnosis import mesh_fault

if TYPE_CHECKING:
    from fd_mitsuba.scene.scene_file import SceneFile


def fault_of_file(file: SceneFile, error: Exception) -> UserError | None:
    """The error as one line about a mesh or a picture that the scene names; None if it is none of theirs."""
    text = str(error)
    for element in file.elements:
        name = element.properties.get("filename")
        if not isinstance(name, str):
            continue
        if element.kind == "shape" and Path(name).name in text and (fault := mesh_fault(file.resolve(name))):
            return element.error(f"{name}: {fault}")
        if element.plugin in ("bitmap", "envmap") and (fault := _picture_fault(file, name, text)):
            return element.error(f"{name}: {fault}")
    return None


def _picture_fault(file: SceneFile, name: str, text: str) -> str | None:
    try:
        with file_threads():
            file.mi.Bitmap(str(file.resolve(name)))
    except MITSUBA_ERRORS as error:
        said = " ".join(str(error).split()).rpartition("] ")[2].strip(" .!")
        return f"{said}; {remedy_for(said)}" if said and said in " ".join(text.split()) else None
    return None
