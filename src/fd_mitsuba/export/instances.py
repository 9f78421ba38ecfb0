"""An exported part in many places: a stock Mitsuba scene with a shape group per part and an instance per placement,
and the same as GLB.

The file of placements is a JSON list. An entry places a part either by a matrix of the user's frame, applied to the
part where it grew, or by its anchor, the point and direction with which it sits on the base:

    {"part": "butterfly", "to_world": [[1, 0, 0, 4], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "base": true}
    {"part": "butterfly", "position": [4, 1, 0], "direction": [0, 1, 0], "twist_deg": 90, "scale": 0.5}

`part` may be left out where there is only one. `"base": true` places the base along with it. What the file places is
nowhere else in the scene; what it does not mention stays as it was.
"""

from __future__ import annotations

import copy
import json
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.instance_glb import instance_glb
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.glb import glb_content
from fd_mitsuba.io.json_object import json_fault, read_json_object, syntax_fault
from fd_mitsuba.io.regular_file import NotReadable, read_regular

_KEYS = {"part", "to_world", "position", "direction", "twist_deg", "scale", "base"}
MOST_PLACEMENTS = 100_000
_MOST_BYTES = 1 << 26


@dataclass(frozen=True)
class Placement:
    """One copy of a part: `to_world` (4, 4) moves what is in the user's frame; `base`: whether the base comes along."""

    part: str
    to_world: np.ndarray
    base: bool = False


def write_instances(run: Path, transforms: Path, name: str) -> list[Path]:
    """Write the scene `name` into RUN/export/mitsuba, beside the exported one whose files it uses; returns its path.

    Where there is an `asset.glb`, the same goes beside that as `<name>.glb`, whose path is returned too.

    Raises:
        UserError: nothing exported there; a name that is no file name or that of the exported scene; see
            `read_placements` and `instance_scene`.
    """
    folder = run / "export"
    scene = folder / "mitsuba" / "scene.xml"
    record = read_json_object(folder / "part.json")
    if record is None and (folder / "part.json").is_file():
        fault = json_fault(folder / "part.json")
        raise UserError(f"{folder / 'part.json'}: is damaged ({fault}); run fd_mitsuba export {run} anew")
    if record is None or not scene.is_file():
        raise UserError(f"{scene}: missing, or without part.json; run fd_mitsuba export {run} first")
    _check_record(folder / "part.json", record)
    exported = scene.read_bytes()
    if Path(name).name != name or name in (scene.name, "asset.xml") or not name.endswith(".xml"):
        raise UserError(f"-o {name}: give a plain file name such as instances.xml; it is written beside {scene}")
    placements = read_placements(transforms, record)
    with _whole(scene, run):
        made = {scene.with_name(name): instance_scene(exported, placements)}
    asset = folder / "asset.glb"
    if asset.is_file():
        data = asset.read_bytes()
        if glb_content(data) is None:
            raise UserError(f"{asset}: is damaged (no whole GLB); run fd_mitsuba export {run} anew")
        with _whole(asset, run):
            made[folder / Path(name).with_suffix(".glb")] = instance_glb(data, placements)
    for path, data in made.items():
        write_atomically(path, data)
    return list(made)


@contextmanager
def _whole(path: Path, run: Path) -> Iterator[None]:
    """Around the use of an exported file: whatever a damaged one does to its parser becomes one line about the file."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        about = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UserError(f"{path}: is damaged ({about}); run fd_mitsuba export {run} anew") from None


def _check_record(path: Path, record: dict[str, Any]) -> None:
    parts = record.get("parts")
    held = list(parts.values()) if isinstance(parts, dict) else []
    anchors = [part.get("anchor") if isinstance(part, dict) else None for part in held]
    numbers = [
        anchor.get(name) if isinstance(anchor, dict) else None
        for anchor in anchors
        for name in ("position", "direction")
    ]
    if not held or not all(map(_is_vector, numbers)):
        raise UserError(f"{path}: is damaged (no parts with their anchors); export the run anew")


def _is_vector(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(isinstance(number, int | float) for number in value)


def read_placements(path: Path, record: dict[str, Any]) -> list[Placement]:
    """The placements in a JSON file.

    Args:
        record: what `part.json` holds: parts and their anchors.

    Raises:
        UserError: an unreadable file, or an entry that does not say where which part goes.
    """
    try:
        entries = json.loads(read_regular(path, _MOST_BYTES))
    except NotReadable as error:
        raise UserError(f"{path}: {error}; give a JSON list of placements") from None
    except RecursionError:
        raise UserError(f"{path}: not a list of placements (nested too deep); write [{{...}}, ...]") from None
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({syntax_fault(error)}); mend that line") from None
    if not isinstance(entries, list) or not entries or len(entries) > MOST_PLACEMENTS:
        raise UserError(f"{path}: not a list of 1 to {MOST_PLACEMENTS} placements; write [{{...}}, ...]")
    return [_placement(f"{path}: placement {number}", entry, record) for number, entry in enumerate(entries, 1)]


def anchored(
    anchor: dict[str, list[float]], position: Any, direction: Any, twist_deg: float, scale: float
) -> np.ndarray:
    """The (4, 4) matrix that brings a part's anchor to `position` (3,) and its direction to `direction` (3,).

        to_world = T(position) twist(direction) R(anchor direction -> direction) scale T(-anchor position)

    R is the rotation by the smallest angle; the twist turns counter-clockwise seen against `direction`.
    """
    start, end = _unit(anchor["direction"]), _unit(direction)
    linear = scale * _about(end, np.radians(twist_deg)) @ _shortest(start, end)
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = np.asarray(position, dtype=np.float64) - linear @ np.asarray(anchor["position"], dtype=np.float64)
    return matrix


def instance_scene(scene: bytes, placements: list[Placement]) -> bytes:
    """The plain exported scene with instances instead of the shapes that are placed.

    Args:
        scene: the XML that `export.mitsuba_xml` wrote: a part's shape has the id `part_<name>`, others are the base.

    Raises:
        UserError: a part without a shape, or a base that emits light, which Mitsuba cannot instance.
    """
    root = ET.fromstring(scene)
    shapes = [element for element in root if element.tag == "shape"]
    parts = {placement.part for placement in placements}
    members: dict[str, list[ET.Element]] = {}
    for name in sorted(parts):
        members[name] = [shape for shape in shapes if shape.get("id") == f"part_{name}"]
        if not members[name]:
            raise UserError(f"part {name!r} is not in the exported scene; export the run anew")
    if any(placement.base for placement in placements):
        members[BASE_NAME] = [shape for shape in shapes if not (shape.get("id") or "").startswith("part_")]
        if any(shape.find("emitter") is not None for shape in members[BASE_NAME]):
            raise UserError('a base shape with a light cannot be placed again; leave out "base"')
    for name, group in members.items():
        holder = ET.SubElement(root, "shape", {"type": "shapegroup", "id": f"group_{name}"})
        for shape in group:
            root.remove(shape)
            holder.append(copy.deepcopy(shape))
    for placement in placements:
        for name in [placement.part] + [BASE_NAME] * placement.base:
            instance = ET.SubElement(root, "shape", {"type": "instance"})
            ET.SubElement(instance, "ref", {"id": f"group_{name}"})
            transform = ET.SubElement(instance, "transform", {"name": "to_world"})
            ET.SubElement(transform, "matrix", {"value": " ".join(f"{v:.9g}" for v in placement.to_world.ravel())})
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _placement(where: str, entry: Any, record: dict[str, Any]) -> Placement:
    parts = record["parts"]
    if not isinstance(entry, dict):
        raise UserError(f"{where}: is no object; write {{...}}")
    unknown = sorted(set(entry) - _KEYS)
    if unknown:
        raise UserError(f"{where}: unknown key {unknown[0]!r}; keys: {', '.join(sorted(_KEYS))}")
    name = entry.get("part", next(iter(parts)) if len(parts) == 1 else None)
    if not isinstance(name, str) or name not in parts:
        raise UserError(f"{where}: part {name!r} is none of {', '.join(parts)}; name one")
    base = entry.get("base", False)
    if not isinstance(base, bool):
        raise UserError(f"{where}: base is {base!r}; write true or false")
    by_anchor = {"position", "direction", "twist_deg", "scale"} & set(entry)
    if ("to_world" in entry) == bool(by_anchor) or (by_anchor and "position" not in entry):
        raise UserError(f'{where}: says not where; give either "to_world" or "position"')
    if "to_world" in entry:
        matrix = _numbers(where, "to_world", entry["to_world"], (4, 4))
        if not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise UserError(f"{where}: to_world is not affine; its last row is 0 0 0 1")
    else:
        anchor = parts[name]["anchor"]
        position = _numbers(where, "position", entry["position"], (3,))
        direction = _numbers(where, "direction", entry.get("direction", anchor["direction"]), (3,))
        if not np.linalg.norm(direction) > 0:
            raise UserError(f"{where}: direction has no length; give one such as [0, 1, 0]")
        twist = float(_numbers(where, "twist_deg", entry.get("twist_deg", 0.0), ()))
        scale = float(_numbers(where, "scale", entry.get("scale", 1.0), ()))
        matrix = anchored(anchor, position, direction, twist, scale)
    stretch = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not stretch[-1] > 1e-9 * max(stretch[0], 1e-30):
        raise UserError(f"{where}: flattens the part; use scales other than 0")
    return Placement(name, matrix, base)


def _numbers(where: str, key: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape != shape or not np.all(np.isfinite(array)):
        wanted = "a finite number" if not shape else f"{' x '.join(map(str, shape))} finite numbers"
        raise UserError(f"{where}: {key} is not {wanted}; correct it")
    return array


def _unit(vector: Any) -> np.ndarray:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector)


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation (3, 3) by `angle` radians about a unit axis."""
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _shortest(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) by the smallest angle that takes one unit vector to another; half a turn has any axis."""
    axis = np.cross(start, end)
    sine, cosine = np.linalg.norm(axis), float(start @ end)
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        return _about(_unit(axis), np.pi)
    return _about(axis / sine, float(np.arctan2(sine, cosine)))
