"""The edited object as a plain Mitsuba scene: stock plugins only, the user's own elements, every file beside it."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.io.safe_text import safe_file_name
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_source import ANALYTIC
from fd_mitsuba.scene.plugins import DUAL_PATH, FOCAL_REGION
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.scene.xml_element import XmlElement

FILES = "files"
"""Folder beside the scene that holds what it reads."""

_OPAQUE = ("principled", "diffuse", "conductor", "roughconductor", "plastic", "roughplastic")
_WRAPPERS = ("twosided", "mask", "normalmap", "bumpmap")


@dataclass(frozen=True)
class MitsubaPart:
    """A part in the scene.

    Attributes:
        label: the shape's id, `part_<name>` or `cut_face_<name>`.
        ply: name of its PLY in the folder `FILES`, UVs with the origin bottom left.
        textures: parameter of the part's BSDF -> picture in `FILES`, and whether it holds sRGB.
        normal_map: picture in `FILES`, or "".
    """

    label: str
    ply: str
    textures: dict[str, tuple[str, bool]] = field(default_factory=dict)
    normal_map: str = ""


def mitsuba_scene(
    scene: EditScene,
    inputs: EditInputs,
    parts: list[MitsubaPart],
    cut: Mapping[int, str | None] | None = None,
    without: Collection[str] = (),
) -> tuple[bytes, dict[str, Path]]:
    """The scene file's bytes, and which files to copy: name in `FILES` -> original.

    Regions, the prompt's integrator and the part's BSDF go; base, lights, media, sensor stay as the user wrote them,
    with `$names` filled in, includes put in place and file names changed. Without a sensor, one that sees the whole
    object is added.

    Args:
        inputs: the scene's files.
        cut: number of a base shape -> the PLY in the folder `FILES` that takes the place of its file, as after a cut;
            None: nothing is left of it.
        without: ids of shapes to leave out.
    """
    own = {
        name for part in parts for name in [part.ply, part.normal_map, *(pair[0] for pair in part.textures.values())]
    }
    cut = cut or {}
    own |= {name for name in cut.values() if name is not None}
    file = inputs.scene
    listed = iter(file.top_level("shape"))
    numbers = {id(element): number for number, element in enumerate(scene.base_elements)}
    around = {id(element): name for element, name in zip(scene.surroundings, scene.surroundings_ids, strict=True)}
    names = _Names(file, own)
    root = ET.Element("scene", {"version": "3.0.0"})
    for element in _elements(file):
        shape = next(listed) if element.tag == "shape" else None
        if element.get("type") in (FOCAL_REGION, DUAL_PATH):
            continue
        if _is_part_bsdf(element):
            continue
        if shape is not None and (id(shape) in numbers or id(shape) in around):
            number = numbers.get(id(shape))
            if element.get("id") in without:
                continue
            if number is None:
                element.set("id", around[id(shape)])
            elif number in cut:
                ply = cut[number]
                if ply is None:
                    continue
                _put_cut_mesh(element, ply)
                names.replace_in(element, but=f"{FILES}/{ply}")
                root.append(element)
                continue
        names.replace_in(element)
        root.append(element)
    if not any(element.tag == "integrator" for element in root):
        root.insert(0, ET.fromstring('<integrator type="path"><integer name="max_depth" value="8"/></integrator>'))
    if not any(element.tag == "sensor" for element in root):
        root.insert(1, _sensor(scene))
    names.file = inputs.part_bsdf()[0]
    part_bsdf = next(filter(_is_part_bsdf, _elements(names.file)), ET.Element("bsdf", {"type": "principled"}))
    names.replace_in(part_bsdf)
    part_bsdf.attrib.pop("id", None)
    for part in parts:
        root.append(_part(part, part_bsdf))
    for element in root.iter():
        for key, value in element.attrib.items():
            element.set(key, value.replace("$", "\\$"))  # it would be a parameter to whoever reads the exported scene
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n", names.copies


def _is_part_bsdf(element: ET.Element) -> bool:
    return element.tag == "bsdf" and element.get("id") == DEFAULT_PART_NAME


def _elements(file: SceneFile) -> list[ET.Element]:
    """The elements below `<scene>` as the scene was read: names filled in, includes in place, spectra as values."""
    return [_copied(child) for child in file.text.root.children]


def _copied(element: XmlElement) -> ET.Element:
    copied = ET.Element(element.tag, element.attributes)
    copied.extend(_copied(child) for child in element.children)
    return copied


class _Names:
    """New names for the files that elements refer to."""

    def __init__(self, file: SceneFile, taken: set[str]) -> None:
        self.file, self.taken = file, taken
        self.copies: dict[str, Path] = {}

    def replace_in(self, element: ET.Element, but: str = "") -> None:
        """Point every file name below an element to its copy, except for the name `but`."""
        for inner in element.iter():
            if inner.tag == "string" and inner.get("name") == "filename" and inner.get("value") != but:
                inner.set("value", self._copy(inner.get("value", "")))

    def _copy(self, name: str) -> str:
        source = self.file.resolve(name).resolve()
        new = next((known for known, original in self.copies.items() if original == source), None)
        if new is None:
            new = safe_file_name(source.name, {*self.taken, *self.copies})
            self.copies[new] = source
        return f"{FILES}/{new}"


def _put_cut_mesh(shape: ET.Element, ply: str) -> None:
    """Let a base shape read another mesh: placed as before if it was a mesh, where it stands if it was analytic."""
    kept = {"bsdf", "ref", "medium"}
    named = {"face_normals"} if shape.get("type") in ANALYTIC else {"face_normals", "flip_normals", "to_world"}
    for child in list(shape):
        if child.tag not in kept and child.get("name") not in named:
            shape.remove(child)
    shape.set("type", "ply")
    _put(shape, "string", "filename", f"{FILES}/{ply}")


def _part(part: MitsubaPart, bsdf: ET.Element) -> ET.Element:
    shape = ET.Element("shape", {"type": "ply", "id": part.label})
    _put(shape, "string", "filename", f"{FILES}/{part.ply}")
    _put(shape, "boolean", "flip_tex_coords", "true")
    bsdf = copy.deepcopy(bsdf)
    leaf, holder = bsdf, None
    while leaf.get("type") in _WRAPPERS and (inner := leaf.find("bsdf")) is not None:
        leaf, holder = inner, leaf
    for parameter, (picture, coloured) in part.textures.items():
        for old in [child for child in leaf if child.get("name") == parameter]:
            leaf.remove(old)
        leaf.append(_bitmap(parameter, picture, raw=not coloured))
    if part.normal_map:
        # At the outline, bent normals look away from the camera, where Mitsuba shows black: a rim around every metal.
        bent = ET.Element("bsdf", {"type": "normalmap"})
        _put(bent, "boolean", "use_shadowing_function", "false")
        bent.append(_bitmap("normalmap", part.normal_map, raw=True))
        # Inside a `twosided`, which Mitsuba wants outermost.
        if holder is None:
            bsdf = ET.Element("bsdf", {"type": "twosided"}) if _is_opaque(leaf) else bent
            if bsdf is not bent:
                bsdf.append(bent)
        else:
            holder.remove(leaf)
            holder.append(bent)
        bent.append(leaf)
    shape.append(bsdf)
    return shape


def _is_opaque(bsdf: ET.Element) -> bool:
    """Whether a BSDF may have the same on its back, for certain."""
    clear = any(child.get("name") == "spec_trans" for child in bsdf)
    return bsdf.get("type") in _OPAQUE and not clear


def _bitmap(name: str, picture: str, raw: bool) -> ET.Element:
    texture = ET.Element("texture", {"type": "bitmap", "name": name})
    _put(texture, "string", "filename", f"{FILES}/{picture}")
    _put(texture, "boolean", "raw", "true" if raw else "false")
    _put(texture, "string", "wrap_mode", "clamp")
    return texture


def _put(element: ET.Element, tag: str, name: str, value: str) -> None:
    ET.SubElement(element, tag, {"name": name, "value": value})


def _sensor(scene: EditScene) -> ET.Element:
    """A camera at azimuth 30 and elevation 15 degrees that sees base and regions whole."""
    points = np.concatenate([scene.base_canonical.vertices] + [region.surface(2).vertices for region in scene.regions])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    azimuth, elevation, fov = np.radians(30.0), np.radians(15.0), 40.0
    right = np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])
    back = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    offset = points - centre
    aside = np.abs(offset @ np.stack([right, np.cross(back, right)], axis=1)).max(axis=1)
    distance = float((aside * 1.08 / np.tan(np.radians(fov / 2)) + offset @ back).max())
    origin, target = scene.frame.to_user(centre + distance * back), scene.frame.to_user(centre)
    sensor = ET.Element("sensor", {"type": "perspective", "id": "sensor"})
    _put(sensor, "float", "fov", f"{fov:g}")
    _put(sensor, "float", "near_clip", f"{0.01 * distance / scene.frame.scale:.6g}")
    _put(sensor, "float", "far_clip", f"{100 * distance / scene.frame.scale:.6g}")
    place = ET.SubElement(sensor, "transform", {"name": "to_world"})
    digits = 15 if scene.origin.any() else 7
    written = {"origin": origin, "target": target, "up": (0, 1, 0)}
    ET.SubElement(place, "lookat", {key: ", ".join(f"{v:.{digits}g}" for v in value) for key, value in written.items()})
    film = ET.SubElement(sensor, "film", {"type": "hdrfilm"})
    _put(film, "integer", "width", "512")
    _put(film, "integer", "height", "512")
    sampler = ET.SubElement(sensor, "sampler", {"type": "independent"})
    _put(sampler, "integer", "sample_count", "64")
    return sensor
