"""Any BSDF of a scene as the metallic-roughness material that glTF, OBJ and game engines know."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.backend.parser_message import MITSUBA_ERRORS
from fd_mitsuba.export.pictures import Picture
from fd_mitsuba.export.scene_pictures import colour_picture, grey_values, normal_picture, opacity_picture, orm_picture
from fd_mitsuba.scene.bsdf_reading import COLOURS, read_material
from fd_mitsuba.scene.file_faults import fault_of_file
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

AlphaMode = Literal["OPAQUE", "MASK", "BLEND"]
_WRAPPERS = ("twosided", "mask", "normalmap", "bumpmap", "blendbsdf")
_TRANSPARENT = ("dielectric", "roughdielectric", "thindielectric", "principledthin")
_EXACT = ("principled", "diffuse")
_LOST = ("anisotropic", "spec_tint", "sheen", "sheen_tint", "flatness", "diff_trans")


@dataclass(frozen=True)
class PbrMaterial:
    """A glTF material; colours linear in [0, 1], roughness as `principled` means it.

    Attributes:
        base_color: multiplies picture and vertex colours.
        base_picture: sRGB.
        orm_picture: green roughness, blue metallic, linear; where there is one, the two numbers do not count.
        normal_picture: tangent space, y up.
        colours: the mesh's colour attribute to multiply with, or "".
        colour_scale: what to multiply that with first.
        alpha_mode: of glTF: how the alpha of `opacity` and `base_picture` is meant.
        notes: what the format cannot say, a sentence each.
    """

    name: str
    base_color: tuple[float, float, float] = (0.5, 0.5, 0.5)
    roughness: float = 0.5
    metallic: float = 0.0
    opacity: float = 1.0
    double_sided: bool = False
    ior: float = 1.5
    specular: float = 1.0
    transmission: float = 0.0
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    base_picture: Picture | None = None
    orm_picture: Picture | None = None
    normal_picture: Picture | None = None
    colours: str = ""
    colour_scale: float = 1.0
    alpha_mode: AlphaMode = "OPAQUE"
    notes: tuple[str, ...] = ()


def pbr_material(file: SceneFile, element: SceneElement | None, name: str) -> PbrMaterial:
    """The nearest metallic-roughness material.

    Args:
        file: the scene.
        element: the BSDF in it; None: Mitsuba's default, grey and diffuse.
        name: of the result.

    Raises:
        UserError: a picture that cannot be read.
    """
    if element is None:
        return PbrMaterial(name, roughness=1.0, specular=0.0)
    material = PbrMaterial(name)
    leaf, notes, opacity = element, [], None
    while leaf.plugin in _WRAPPERS:
        nested = [child for child in _children(file, leaf).values() if child.kind == "bsdf"]
        if not nested:
            break
        if leaf.plugin == "mask":
            texture = _children(file, leaf).get("opacity")
            opacity = texture if texture is not None and texture.plugin == "bitmap" else opacity
        material = _unwrapped(file, leaf, material, notes)
        leaf = nested[0]
    textures = {key: child for key, child in _children(file, leaf).items() if child.kind == "texture"}
    values = _means(file, element)
    kept = {key: getattr(material, key) if math.isnan(value) else value for key, value in values["numbers"].items()}
    material = replace(material, **kept)
    if not np.isnan(values["base_color"]).any():
        material = replace(material, base_color=tuple(float(v) for v in np.clip(values["base_color"], 0, 1)))
    material = _lobes(leaf, material)
    material = _textured(file, leaf, textures, material, notes)
    if opacity is not None:
        material = with_opacity(file, opacity, material, notes)
    if leaf.plugin not in _EXACT:
        notes.append(f"nearest to Mitsuba's {leaf.plugin}")
    lost = [key for key in _LOST if key in leaf.properties or key in textures]
    if lost:
        notes.append(f"without {', '.join(lost)}")
    return replace(material, notes=tuple(notes))


def with_opacity(file: SceneFile, texture: SceneElement, material: PbrMaterial, notes: list[str]) -> PbrMaterial:
    """The material with a bitmap of opacities in the alpha of its base colour."""
    picture, is_cut = opacity_picture(file, texture, material.base_picture, material.name, notes)
    return replace(material, base_picture=picture, alpha_mode="MASK" if is_cut else "BLEND")


def _children(file: SceneFile, element: SceneElement) -> dict[str, SceneElement]:
    return {key: file.elements[index] for key, index in element.children.items()}


def _unwrapped(file: SceneFile, element: SceneElement, material: PbrMaterial, notes: list[str]) -> PbrMaterial:
    """What a wrapper such as `twosided` adds to the material."""
    children = _children(file, element)
    if element.plugin == "twosided":
        return replace(material, double_sided=True)
    if element.plugin == "mask":
        opacity = element.properties.get("opacity", 0.5)
        if "opacity" in children and children["opacity"].plugin == "bitmap":
            return material
        if "opacity" in children or not isinstance(opacity, float):
            notes.append("the opacity is not constant and left out")
            return material
        opacity = float(np.clip(opacity, 0, 1))
        return replace(material, opacity=opacity, alpha_mode="OPAQUE" if opacity == 1 else "BLEND")
    texture = children.get("normalmap")
    if element.plugin == "normalmap" and texture is not None and texture.plugin == "bitmap":
        return replace(material, normal_picture=normal_picture(file, texture, material.name, notes))
    notes.append(f"without its {element.plugin}" if element.plugin != "blendbsdf" else "the mean of two BSDFs")
    return material


def _means(file: SceneFile, element: SceneElement) -> dict[str, Any]:
    """What the BSDF says over the unit square of UVs, on average; NaN where it says nothing."""
    import drjit as dr

    mi, side = file.mi, 16
    try:
        with file.searching(), file_threads():
            bsdf = mi.load_dict(file.description(element), parallel=False)
    except MITSUBA_ERRORS as error:  # a picture that was there when the scene was read
        raise (fault_of_file(file, error) or file.translated(error)) from None
    interaction = dr.zeros(mi.SurfaceInteraction3f, side * side)
    index = dr.arange(mi.UInt32, side * side)
    interaction.uv = mi.Point2f((index % side + 0.5) / side, (index // side + 0.5) / side)
    reading = read_material(mi, bsdf, interaction, side * side)
    numbers = {"roughness": float(reading.roughness.mean()), "metallic": float(reading.metallic.mean())}
    numbers = {key: min(max(value, 0.0), 1.0) if value == value else value for key, value in numbers.items()}
    return {"base_color": reading.base_color.mean(axis=0), "numbers": numbers}


def _lobes(leaf: SceneElement, material: PbrMaterial) -> PbrMaterial:
    """Refraction, transmission, clear coat."""
    given = {key: value for key, value in leaf.properties.items() if isinstance(value, float)}
    if leaf.plugin == "diffuse":
        return replace(material, specular=0.0)
    if leaf.plugin in ("principled", "principledthin"):
        # Mitsuba: specular = ((eta - 1) / (eta + 1))^2 / 0.08
        root = math.sqrt(0.08 * min(max(given.get("specular", 0.5), 0.0), 1.0))
        ior = given.get("eta", (1 + root) / (1 - root))
        gloss = given.get("clearcoat_gloss", 0.0)
        return replace(
            material,
            ior=max(round(ior, 6), 1.0),
            transmission=min(max(given.get("spec_trans", 0.0), 0.0), 1.0),
            clearcoat=0.25 * min(max(given.get("clearcoat", 0.0), 0.0), 1.0),
            clearcoat_roughness=math.sqrt(0.1 + (0.001 - 0.1) * gloss),
        )
    if leaf.plugin in _TRANSPARENT:
        rough = math.sqrt(given.get("alpha", 0.1)) if leaf.plugin == "roughdielectric" else 0.0
        ior = given.get("int_ior", 1.5046)
        return replace(material, base_color=(1.0, 1.0, 1.0), roughness=rough, metallic=0.0, ior=ior, transmission=1.0)
    if "plastic" in leaf.plugin:
        return replace(material, ior=given.get("int_ior", 1.49))
    return material


def _textured(
    file: SceneFile,
    leaf: SceneElement,
    textures: dict[str, SceneElement],
    material: PbrMaterial,
    notes: list[str],
) -> PbrMaterial:
    colour = next((textures[key] for key in COLOURS if key in textures), None)
    if colour is not None and colour.plugin == "mesh_attribute":
        scale = float(colour.properties.get("scale", 1.0))
        attribute = str(colour.properties.get("name", ""))
        material = replace(material, base_color=(1.0, 1.0, 1.0), colours=attribute, colour_scale=scale)
    elif colour is not None and colour.plugin == "bitmap":
        picture = colour_picture(file, colour, material.name, notes)
        material = replace(material, base_color=(1.0, 1.0, 1.0), base_picture=picture)
    elif colour is not None and colour.plugin not in ("uniform", "srgb"):
        notes.append(f"the mean of a {colour.plugin} as base colour")
    rough = next((textures[key] for key in ("roughness", "alpha") if key in textures), None)
    metal = textures.get("metallic")
    bitmaps = [texture for texture in (rough, metal) if texture is not None and texture.plugin == "bitmap"]
    for texture in (rough, metal):
        if texture is not None and texture.plugin == "mesh_attribute":
            notes.append("without a roughness or metallic per vertex")
            material = replace(material, roughness=0.5) if texture is rough else replace(material, metallic=0.0)
    if not bitmaps:
        return material
    roughness, metallic = material.roughness, material.metallic
    if rough in bitmaps:
        roughness = grey_values(file, rough)
        roughness = np.sqrt(roughness.clip(min=0)) if "roughness" not in textures else roughness
    if metal is not None and metal in bitmaps:
        metallic = grey_values(file, metal)
    return replace(material, orm_picture=orm_picture(bitmaps[0], roughness, metallic, material.name, notes))
