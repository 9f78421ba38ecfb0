"""A scene to edit, written from shapes: one folder with everything in it that Mitsuba reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fd_mitsuba.assets.bsdf_xml import AddImage, bsdf_element
from fd_mitsuba.assets.region_xml import region_element
from fd_mitsuba.assets.shapes import SceneShape
from fd_mitsuba.conventions import BASE_NAME, DEFAULT_PART_NAME
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.attribute_ply import attribute_ply
from fd_mitsuba.io.safe_text import safe_name
from fd_mitsuba.scene.region_words import PlacedRegion

SCENE_NAME = "scene.xml"


@dataclass(frozen=True)
class SceneText:
    """What a scene says beside its shapes.

    Attributes:
        prompt, base_prompt: of `dual_path`.
        light: an EXR file, which is copied.
        comment: of the scene's first line.
        unit: "mm", "cm" or "m"; None: it is not known.
    """

    prompt: str
    base_prompt: str
    light: Path
    comment: str
    unit: str | None = None


def write_scene(
    folder: Path,
    shapes: Sequence[SceneShape],
    to_scene: np.ndarray,
    regions: Sequence[PlacedRegion],
    text: SceneText,
    notes: list[str],
) -> Path:
    """Write meshes, images, light and `scene.xml`, which comes last; returns its path.

    Args:
        folder: is made if it is missing.
        to_scene: (4, 4) from the asset's frame.
        regions: in the scene's frame.
        notes: takes what a material cannot say.

    Raises:
        UserError: the folder cannot be written.
    """
    taken: list[str] = [SCENE_NAME]

    def add(name: str, data: bytes, suffix: str) -> str:
        filename = safe_name(name, taken, suffix)
        taken.append(filename)
        write_atomically(folder / filename, data)
        return filename

    root = ElementTree.Element("scene", version="3.0.0")
    root.append(ElementTree.Comment(f" {text.comment.replace('--', '- -').strip('-')} "))
    light = add(text.light.stem, text.light.read_bytes(), ".exr")
    for name, value in (("prompt", text.prompt), ("light", light), ("light_scale", "1")):
        ElementTree.SubElement(root, "default", name=name, value=value.replace("$", r"\$"))
    integrator = ElementTree.SubElement(root, "integrator", type="dual_path")
    ElementTree.SubElement(integrator, "string", name="prompt", value="$prompt")
    ElementTree.SubElement(integrator, "string", name="base_prompt", value=text.base_prompt.replace("$", r"\$"))
    if text.unit is not None:
        ElementTree.SubElement(integrator, "string", name="unit", value=text.unit)
    emitter = ElementTree.SubElement(root, "emitter", type="envmap", id="light")
    ElementTree.SubElement(emitter, "string", name="filename", value="$light")
    ElementTree.SubElement(emitter, "float", name="scale", value="$light_scale")
    names: list[str] = [DEFAULT_PART_NAME, "light", *(region.name for region in regions)]
    for shape in shapes:
        wanted = shape.name or BASE_NAME
        if wanted.lower().startswith((f"{DEFAULT_PART_NAME}_", "cut_face_")):  # which names parts of earlier rounds
            wanted = f"{BASE_NAME}_{wanted}"
        name = BASE_NAME if len(shapes) == 1 else safe_name(wanted, names)
        names.append(name)
        root.append(_shape(shape, name, to_scene, add, notes))
    part = ElementTree.SubElement(root, "bsdf", type="principled", id=DEFAULT_PART_NAME)
    ElementTree.SubElement(part, "rgb", name="base_color", value="0.6, 0.6, 0.6")
    ElementTree.SubElement(part, "float", name="roughness", value="0.5")
    for region in regions:
        root.append(region_element(region))
    ElementTree.indent(root)
    path = folder / SCENE_NAME
    write_atomically(path, ElementTree.tostring(root, encoding="utf-8") + b"\n")
    return path


def _shape(shape: SceneShape, name: str, to_scene: np.ndarray, add: AddImage, notes: list[str]) -> ElementTree.Element:
    attributes = {} if shape.colours is None else {"vertex_color": shape.colours}
    data = attribute_ply(shape.vertices, shape.faces, shape.normals, shape.uv, attributes)
    element = ElementTree.Element("shape", type="ply", id=name)
    ElementTree.SubElement(element, "string", name="filename", value=add(name, data, ".ply"))
    if shape.normals is None:
        ElementTree.SubElement(element, "boolean", name="face_normals", value="true")
    matrix = to_scene @ shape.to_asset
    if not np.array_equal(matrix, np.eye(4)):
        transform = ElementTree.SubElement(element, "transform", name="to_world")
        rows = " ".join(f"{value + 0.0:.17g}" for value in matrix.ravel())
        ElementTree.SubElement(transform, "matrix", value=rows)
    element.append(bsdf_element(shape.material, shape.colours is not None, add, notes))
    return element
