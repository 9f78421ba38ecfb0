"""What the appearance stage needs of a scene and the geometry stage does not: light, sound textures, UVs for them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.base_appearance import base_shapes
from fd_mitsuba.scene.bsdf_reading import COLOURS
from fd_mitsuba.scene.edit_scene import EditScene, base_elements
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile, file_threads

_SHARES = (*COLOURS, "roughness", "metallic", "alpha", "alpha_u", "alpha_v")
"""Parameters of a BSDF that mean nothing outside [0, 1]; Mitsuba renders nonsense with some of them, silently."""

_WITHOUT_UVS = (
    "mesh_attribute",
    "volume",
    "uniform",
    "srgb",
    "regular",
    "irregular",
    "d65",
    "blackbody",
    "rawconstant",
)
"""Textures that do not look at UVs."""


def check_appearance_inputs(scene: EditScene) -> tuple[str, ...]:
    """Warnings, a line each; a UserError for what would spoil the learned material, one line with element and remedy.

    Raises:
        UserError: no emitter; a picture of the light or of a texture with NaN or infinity, or a light all black; a
            light's scale that is not positive; a base that has a bitmap but no UVs, or names a mesh attribute that it
            does not have; a base colour, reflectance, roughness, metallic or alpha outside [0, 1].
    """
    warnings: list[str] = []
    inputs = scene.inputs()
    file, (_, part) = inputs.scene, inputs.part_bsdf()
    if not scene.has_light:
        raise UserError(f'{scene.path}: no emitter; a material is learned under light, add <emitter type="constant"/>')
    for element in file.elements:
        if element.kind == "emitter":
            _check_light(file, element, warnings)
        elif element.kind == "texture" and element.plugin == "bitmap":
            _check_picture(file, element, warnings)
        elif element.kind == "bsdf":
            _check_shares(element)
    if part is not None:
        _check_shares(part)
    _, shapes = base_shapes(scene)
    for element, shape in zip(base_elements(file), shapes, strict=True):
        if isinstance(shape, file.mi.Mesh):
            _check_textures(file, element, shape)
    return tuple(warnings)


def _check_light(file: SceneFile, element: SceneElement, warnings: list[str]) -> None:
    scale = element.properties.get("scale", 1.0)
    if isinstance(scale, int | float) and not 0 < scale < np.inf:
        raise element.error(f"scale is {scale:g}; use a positive number")
    values = _check_picture(file, element, warnings)
    if values is not None and not np.any(values > 0):
        raise element.error(f"{element.properties['filename']} is black; use a picture with light in it")


def _check_picture(file: SceneFile, element: SceneElement, warnings: list[str]) -> np.ndarray | None:
    """The picture (H, W, channels) of an element that names one, checked."""
    name = element.properties.get("filename")
    if not isinstance(name, str):
        return None
    try:
        with file_threads():
            values = np.array(file.mi.Bitmap(str(file.resolve(name))))
    except RuntimeError as error:
        raise element.error(f"{name}: {file.translated(error)}; save the picture anew") from None
    if values.dtype.kind == "f":
        broken = int(np.sum(~np.isfinite(values)))
        if broken:
            raise element.error(f"{name} holds NaN or infinity ({broken} of {values.size} values); save it without")
        if values.min() < 0:
            # Resizing a picture with a sharp filter leaves a few: they darken, but nothing breaks.
            share, least = np.mean(values < 0), values.min()
            problem = f"{share:.2g} of the values of {name} are negative, down to {least:.3g}; clamp them to 0"
            warnings.append(str(element.error(problem)))
    return values


def _check_shares(element: SceneElement) -> None:
    for name in _SHARES:
        value = element.properties.get(name)
        try:
            numbers = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            continue  # a spectrum, which Mitsuba checks itself
        if value is not None and not np.all((numbers >= 0) & (numbers <= 1)):
            raise element.error(f"{name} is {_short(numbers)}; use values between 0 and 1")


def _check_textures(file: SceneFile, element: SceneElement, mesh: Any) -> None:
    for texture in _below(file, element):
        source = texture.properties.get("filename") or f'<texture type="{texture.plugin}">'
        if texture.plugin == "mesh_attribute":
            attribute = texture.properties.get("name")
            if not np.all(np.array(mesh.has_attribute(attribute))):
                known = [key for key in file.mi.traverse(mesh).keys() if key.startswith(("vertex_", "face_"))]
                known = [key for key in known if key not in ("vertex_positions", "vertex_normals", "vertex_texcoords")]
                have = f"it has {', '.join(known)}" if known else "it has none"
                raise element.error(f"its mesh has no attribute {attribute!r} ({have}); save the mesh with it")
        elif texture.plugin not in _WITHOUT_UVS and not mesh.has_vertex_texcoords():
            raise element.error(f"{source} needs UVs, and its mesh has none; unwrap the mesh or give a plain colour")


def _below(file: SceneFile, element: SceneElement) -> Iterator[SceneElement]:
    """The textures in the BSDFs of a shape."""
    for position in element.children.values():
        child = file.elements[position]
        if child.kind == "texture":
            yield child
        if child.kind in ("bsdf", "texture"):
            yield from _below(file, child)


def _short(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:g}" for number in numbers.reshape(-1))
