"""A material as a `principled` BSDF in XML, and the image files that it reads."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from fd_mitsuba.assets.asset import AssetMaterial, Texture, TextureImage
from fd_mitsuba.assets.images import pixels, png_bytes
from fd_mitsuba.io.srgb import linear_from_srgb, srgb_from_linear

AddImage = Callable[[str, bytes, str], str]
"""Takes a name, the bytes and the suffix of an image, and gives the name of its file in the scene's folder."""
_GLOSS = (0.1, 0.001)
"""Mitsuba's clear coat: alpha at gloss 0 and at gloss 1."""


def bsdf_element(material: AssetMaterial, coloured: bool, add: AddImage, notes: list[str]) -> ElementTree.Element:
    """The `<bsdf>`.

    Args:
        coloured: whether the mesh's `vertex_color` is the base colour.
        add: for the images.
        notes: takes what cannot be said, a sentence each.
    """
    surface = ElementTree.Element("bsdf", type="principled")
    writer = _Writer(material, add, notes)
    writer.base_colour(surface, coloured)
    if material.unlit:
        notes.append(f"material {material.name!r} is unlit, and is taken for a matt surface")
        material = replace(material, roughness=1.0, roughness_texture=None, metallic=0.0, metallic_texture=None)
    writer.number(surface, "roughness", material.roughness, material.roughness_texture)
    writer.number(surface, "metallic", material.metallic, material.metallic_texture)
    _lobes(surface, material)
    found = surface
    if material.normal_texture is not None:
        found = _around("normalmap", found)
        image = material.normal_texture.image
        writer.bitmap(
            found, "normalmap", material.normal_texture, add(f"{material.name}_normal", image.data, image.suffix), True
        )
    if material.double_sided and not material.transmission > 0:
        found = _around("twosided", found)
    return writer.masked(found)


class _Writer:
    def __init__(self, material: AssetMaterial, add: AddImage, notes: list[str]) -> None:
        self.material, self.add, self.notes = material, add, notes

    def base_colour(self, parent: ElementTree.Element, coloured: bool) -> None:
        material, texture = self.material, self.material.base_texture
        if coloured:
            attribute = ElementTree.SubElement(parent, "texture", type="mesh_attribute", name="base_color")
            ElementTree.SubElement(attribute, "string", name="name", value="vertex_color")
        elif texture is None:
            ElementTree.SubElement(parent, "rgb", name="base_color", value=_list(material.base_color))
        else:
            image = texture.image
            if any(abs(value - 1) > 1e-6 for value in material.base_color):
                image = _tinted(image, material.base_color)
                self.notes.append(f"material {material.name!r}: its colour is multiplied into its texture")
            name = self.add(f"{material.name}_base_color", image.data, image.suffix)
            self.bitmap(parent, "base_color", texture, name, False)

    def number(self, parent: ElementTree.Element, key: str, factor: float, texture: Texture | None) -> None:
        """A constant, or a grey image of one channel times the factor."""
        values = None if texture is None else _channel(texture)
        if texture is None or values is None:
            ElementTree.SubElement(parent, "float", name=key, value=_text(factor))
        elif (values == values.flat[0]).all():
            ElementTree.SubElement(
                parent, "float", name=key, value=_text(round(float(values.flat[0]) / 255 * factor, 6))
            )
        else:
            scaled = (values * factor + 0.5).clip(0, 255).astype(np.uint8)
            name = self.add(f"{self.material.name}_{key}", png_bytes(Image.fromarray(scaled)), ".png")
            self.bitmap(parent, key, texture, name, True)

    def masked(self, found: ElementTree.Element) -> ElementTree.Element:
        """The BSDF within a `mask` where parts of it can be seen through."""
        material = self.material
        if material.alpha_mode == "OPAQUE":
            return found
        texture = material.opacity_texture
        alpha = None if texture is None else _channel(texture)
        values = np.full((1, 1), 255.0) if alpha is None else alpha.astype(np.float64)
        values = values * material.opacity
        if material.alpha_mode == "MASK":
            values = np.where(values >= material.alpha_cutoff * 255 - 1e-6, 255.0, 0.0)
        if (values >= 254.5).all():
            return found
        mask = _around("mask", found)
        if texture is None or (values == values.flat[0]).all():
            ElementTree.SubElement(mask, "float", name="opacity", value=_text(round(float(values.flat[0]) / 255, 6)))
        else:
            data = png_bytes(Image.fromarray((values + 0.5).clip(0, 255).astype(np.uint8)))
            self.bitmap(mask, "opacity", texture, self.add(f"{material.name}_opacity", data, ".png"), True)
        return mask

    def bitmap(self, parent: ElementTree.Element, key: str, texture: Texture, filename: str, raw: bool) -> None:
        found = ElementTree.SubElement(parent, "texture", type="bitmap", name=key)
        ElementTree.SubElement(found, "string", name="filename", value=filename)
        if raw:
            ElementTree.SubElement(found, "boolean", name="raw", value="true")
        if texture.wrap != "repeat":
            ElementTree.SubElement(found, "string", name="wrap_mode", value=texture.wrap)
        if texture.nearest:
            ElementTree.SubElement(found, "string", name="filter_type", value="nearest")
        matrix = np.asarray(texture.to_uv, dtype=np.float64)
        if not np.array_equal(matrix, np.eye(3)):
            (a, b, c), (d, e, f) = matrix[:2]
            transform = ElementTree.SubElement(found, "transform", name="to_uv")
            rows = (a, b, 0.0, c, d, e, 0.0, f, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
            ElementTree.SubElement(transform, "matrix", value=" ".join(map(_text, rows)))


def _around(plugin: str, nested: ElementTree.Element) -> ElementTree.Element:
    outer = ElementTree.Element("bsdf", type=plugin)
    outer.append(nested)
    return outer


def _lobes(surface: ElementTree.Element, material: AssetMaterial) -> None:
    reflectance = ((material.ior - 1) / (material.ior + 1)) ** 2  # at normal incidence: 0.08 specular
    specular = 0.0 if material.unlit else min(reflectance / 0.08 * material.specular, 1.0)
    if abs(specular - 0.5) > 1e-6:
        ElementTree.SubElement(surface, "float", name="specular", value=_text(round(specular, 6)))
    if material.transmission > 0:
        ElementTree.SubElement(surface, "float", name="spec_trans", value=_text(material.transmission))
    if material.clearcoat > 0:
        gloss = (_GLOSS[0] - material.clearcoat_roughness**2) / (_GLOSS[0] - _GLOSS[1])
        ElementTree.SubElement(surface, "float", name="clearcoat", value=_text(min(4 * material.clearcoat, 1.0)))
        gloss = round(min(max(gloss, 0.0), 1.0), 6)
        ElementTree.SubElement(surface, "float", name="clearcoat_gloss", value=_text(gloss))


def _channel(texture: Texture) -> np.ndarray | None:
    """(H, W) uint8 of the channel that a texture means; None for an alpha that the image does not have."""
    values, channel = pixels(texture.image), texture.channel or 0
    if channel < values.shape[2]:
        return values[..., channel]
    return None if channel == 3 else values[..., 0]


def _tinted(image: TextureImage, colour: tuple[float, float, float]) -> TextureImage:
    values = pixels(image)
    rgb = np.broadcast_to(values[..., :3], (*values.shape[:2], 3)) if values.shape[2] < 3 else values[..., :3]
    tinted = srgb_from_linear(linear_from_srgb(rgb / 255.0) * np.array(colour))
    stream = io.BytesIO()
    Image.fromarray((tinted * 255 + 0.5).astype(np.uint8)).save(stream, format="PNG", compress_level=4)
    return TextureImage(image.name, stream.getvalue(), ".png")


def _text(value: float) -> str:
    return f"{value:.10g}"


def _list(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
