"""What the appearance stage needs of a scene and the geometry stage does not: light, sound textures, UVs for them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.backend.parser_message import MITSUBA_ERRORS
from fd_mitsuba.backend.startup import NORMALS, UVS, VERTICES
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.base_appearance import base_shapes
from fd_mitsuba.scene.bsdf_reading import COLOURS
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.lit_side import shading_warnings
from fd_mitsuba.scene.mesh_diagnosis import obj_has_colours
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

_SHARES = (*COLOURS, "roughness", "metallic", "alpha", "alpha_u", "alpha_v")
"""Parameters of a BSDF that mean nothing outside [0, 1]; Mitsuba renders nonsense with some of them, silently."""

_OVERSHOOT = 0.005
"""Share of a texture's values above 1 up to which it is still taken for a reflectance."""

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
        UserError: no emitter; a BSDF of the base that Mitsuba loads but cannot render; a picture of the light or of a
            texture with NaN or infinity, or a light all black; a light's scale that is not positive; a base that has a
            bitmap but no UVs, or names a mesh attribute that it does not have; a base colour, reflectance, roughness,
            metallic or alpha outside [0, 1], as a number, in a picture or in an attribute of the mesh.
    """
    warnings: list[str] = []
    inputs = scene.inputs
    file, (_, part) = inputs.scene, inputs.part_bsdf()
    if not scene.has_light:
        raise UserError(f'{scene.path}: no emitter; a material is learned under light, add <emitter type="constant"/>')
    shares = _share_textures(file)
    for position, element in enumerate(file.elements):
        if element.kind == "emitter":
            _check_light(file, element, warnings)
        elif element.kind == "texture" and element.plugin == "bitmap":
            values = _check_picture(file, element, warnings)
            if values is not None and values.dtype.kind == "f" and position in shares:
                _check_range(element, shares[position], str(element.properties["filename"]), values, warnings)
        elif element.kind == "bsdf":
            _check_shares(element)
    if part is not None:
        _check_shares(part)
    loaded, shapes = base_shapes(scene)
    for element, shape in zip(scene.base_elements, shapes, strict=True):
        if isinstance(shape, file.mi.Mesh):
            _check_textures(file, element, shape, warnings)
    return (*warnings, *check_shading(scene, loaded, shapes))


def check_shading(scene: EditScene, loaded: Any, shapes: list[Any]) -> list[str]:
    """`lit_side.shading_warnings` of the scene as it was loaded, and the base's shapes in it.

    Raises:
        UserError: a BSDF that Mitsuba loads but cannot render.
    """
    file = scene.inputs.scene
    try:
        return shading_warnings(file.mi, loaded, shapes, scene.render_base)
    except RuntimeError as error:
        problem = str(file.translated(error)).removeprefix(f"{file.path}: ")
        raise UserError(f"{scene.path}: Mitsuba cannot shade the base: {problem}") from None


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
    except MITSUBA_ERRORS as error:
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


def _share_textures(file: SceneFile) -> dict[int, str]:
    """Position in the file's elements of the textures that feed one of `_SHARES` -> which."""
    return {
        position: name
        for element in file.elements
        if element.kind == "bsdf"
        for name, position in element.children.items()
        if name in _SHARES and file.elements[position].kind == "texture"
    }


def _check_range(element: SceneElement, name: str, source: str, values: np.ndarray, warnings: list[str]) -> None:
    above = float(np.mean(values > 1.001))
    if above > _OVERSHOOT:
        problem = f"{name} reads {source}, whose values go up to {values.max():.3g}"
        raise element.error(f"{problem}; a surface gives back at most 1: scale them to between 0 and 1")
    if above > 0:
        # Resizing with a sharp filter overshoots here and there.
        problem = f"{above:.2g} of the values of {source} are above 1, up to {values.max():.3g}; clamp them to 1"
        warnings.append(str(element.error(problem)))


def _check_textures(file: SceneFile, element: SceneElement, mesh: Any, warnings: list[str]) -> None:
    for name, texture in _below(file, element):
        source = texture.properties.get("filename") or f'<texture type="{texture.plugin}">'
        if texture.plugin == "mesh_attribute":
            attribute = str(texture.properties.get("name"))
            if not np.all(np.array(mesh.has_attribute(attribute))):
                raise element.error(_no_attribute(file, element, mesh, attribute))
            if name in _SHARES:
                values = np.array(file.mi.traverse(mesh)[attribute]) * float(texture.properties.get("scale", 1.0))
                _check_range(element, name, attribute, values, warnings)
        elif texture.plugin not in _WITHOUT_UVS and not mesh.has_vertex_texcoords():
            raise element.error(f"{source} needs UVs, and its mesh has none; unwrap the mesh or give a plain colour")


def _no_attribute(file: SceneFile, element: SceneElement, mesh: Any, attribute: str) -> str:
    filename = element.properties.get("filename")
    if attribute == "vertex_color" and isinstance(filename, str) and obj_has_colours(file.resolve(filename)):
        lost = f"{filename}: Mitsuba's OBJ reader leaves out the colours behind the positions"
        return f'{lost}, so that there is no {attribute!r}; save the mesh as PLY and write type="ply"'
    known = [key for key in file.mi.traverse(mesh).keys() if key.startswith(("vertex_", "face_"))]
    known = [key for key in known if key not in (VERTICES, NORMALS, UVS)]
    have = f"it has {', '.join(known)}" if known else "it has none"
    return f"its mesh has no attribute {attribute!r} ({have}); save the mesh with it"


def _below(file: SceneFile, element: SceneElement, name: str = "") -> Iterator[tuple[str, SceneElement]]:
    """The textures in the BSDFs of a shape, each with the BSDF's parameter that it feeds."""
    for key, position in element.children.items():
        child = file.elements[position]
        fed = name if element.kind == "texture" else key
        if child.kind == "texture":
            yield fed, child
        if child.kind in ("bsdf", "texture"):
            yield from _below(file, child, fed)


def _short(numbers: np.ndarray) -> str:
    return ", ".join(f"{number:g}" for number in numbers.reshape(-1))
