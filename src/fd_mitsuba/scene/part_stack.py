"""The parts of an edited object, round by round: what `stack.json` beside an exported `scene.xml` says of them.

An exported scene is edited again like any other scene. Its shapes `part_<name>` are parts of earlier rounds: they are
base while the next part grows, and stay meshes of their own in what that round exports.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError, first_line
from fd_mitsuba.io.json_object import json_fault
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

RECORD_NAME = "stack.json"
UNITS = ("mm", "cm", "m")
"""That a scene can say."""
SHOWN, HIDDEN, REMOVED = "shown", "hidden", "removed"

_PREFIX = "part_"
_FORMAT = 1


@dataclass(frozen=True)
class StackedPart:
    """One part of the stack.

    Attributes:
        name: its shape in the scene has the id `part_<name>`.
        prompt: of the round that it grew in, "" where nothing says.
        round: from 1 on.
        faces: triangles.
        file: its mesh, as the scene names it.
        pictures: its textures, as the scene names them.
        normal: its normal map for other programs than Mitsuba, beside those; "" without.
        factor: what a GLB multiplies its base colour with.
        state: `SHOWN`, `HIDDEN` (left out of exports) or `REMOVED` (its files are gone too).
    """

    name: str
    prompt: str = ""
    round: int = 1
    faces: int = 0
    file: str = ""
    pictures: tuple[str, ...] = ()
    normal: str = ""
    factor: tuple[float, ...] = (1.0, 1.0, 1.0)
    state: str = SHOWN

    @property
    def shape(self) -> str:
        """The id of its shape in the scene; also the name of its node in a GLB."""
        return f"{_PREFIX}{self.name}"

    def normal_path(self, folder: Path) -> Path | None:
        """Where `normal` is, for a scene in `folder`; None where it is not, or not within that folder."""
        path = (folder / self.normal).resolve()
        return path if self.normal and path.is_file() and path.is_relative_to(folder.resolve()) else None


def earlier_parts(scene: Path, base: Iterable[TriangleMesh]) -> tuple[StackedPart, ...]:
    """The parts of earlier rounds among a scene's base meshes: those called `part_<name>`.

    Where all are called so, none is: an object has a base.

    Raises:
        UserError: a `stack.json` beside the scene that cannot be read.
    """
    meshes = tuple(base)
    if all(_name(mesh.name) for mesh in meshes):
        return ()
    known = {part.name: part for part in read_stack(scene.parent)[0]}
    found = []
    for mesh in meshes:
        if name := _name(mesh.name):
            file = mesh.source_files[0].name if mesh.source_files else ""
            part = known.get(name, StackedPart(name, file=file))
            found.append(replace(part, faces=len(mesh.faces), state=SHOWN))
    return tuple(found)


def free_name(wanted: str, taken: Collection[str]) -> str:
    """`wanted`, or the first of wanted_2, wanted_3, ... that is not taken, capitals or not."""
    low = {name.lower() for name in taken}
    names = itertools.chain([wanted], (f"{wanted}_{number}" for number in itertools.count(2)))
    return next(name for name in names if name.lower() not in low)


def read_stack(folder: Path) -> tuple[tuple[StackedPart, ...], dict[str, Any]]:
    """The parts that `stack.json` in a folder lists, and how they were exported; nothing where there is no such file.

    Raises:
        UserError: it is damaged.
    """
    path = folder / RECORD_NAME
    if not path.is_file():
        return (), {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        names = {field.name for field in fields(StackedPart)}
        entries = [{key: value for key, value in entry.items() if key in names} for entry in record["parts"]]
        parts = tuple(_entry(entry) for entry in entries)
        return parts, _export_settings(record.get("export", {}))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        fault = json_fault(path) or f"parts: {first_line(error)}"
        raise UserError(
            f"{path}: is damaged ({fault}); export the run anew, or delete it (prompts and rounds are lost)"
        ) from None


def stack_bytes(parts: Iterable[StackedPart], export: dict[str, Any]) -> bytes:
    """What `stack.json` holds: the parts in order, and how they were exported, such as the texture size."""
    record = {"format": _FORMAT, "parts": [asdict(part) for part in parts], "export": export}
    return (json.dumps(record, indent=2) + "\n").encode()


def _export_settings(values: dict[str, Any]) -> dict[str, Any]:
    for name, usual in (("texture_size", 1024), ("faces", None)):
        value = values.get(name, usual)
        if isinstance(value, bool) or not (isinstance(value, int) or value is usual):
            raise ValueError(f"{name} is no number")
    levels = values.get("levels", [])
    if not isinstance(levels, list) or any(type(level) is not int for level in levels):
        raise ValueError("levels are no numbers")
    if values.get("unit") not in (None, *UNITS):
        raise ValueError("an unknown unit")
    return dict(values)


def _entry(values: dict[str, Any]) -> StackedPart:
    given: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    part = StackedPart(**given)
    if not all(isinstance(value, str) for value in (part.name, part.prompt, part.file, part.normal, *part.pictures)):
        raise ValueError("not text")
    if Path(part.shape).name != part.shape:  # it becomes part of a file's name
        raise ValueError("not a name")
    if not isinstance(part.round, int) or len([float(value) for value in part.factor]) != 3:
        raise ValueError("not a number")
    return part


def is_part(shape: str) -> bool:
    """Whether a shape's id is that of an exported part."""
    return bool(_name(shape))


def _name(shape: str) -> str:
    return shape.removeprefix(_PREFIX) if shape.startswith(_PREFIX) else ""
