"""Materials of glTF 2 with the extensions that change what is seen in daylight."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from fd_mitsuba.assets.asset import AssetMaterial, Texture, Wrap
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.gltf_file import GltfFile

_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
_NEAREST = (9728, 9984, 9986)
_LEFT_OUT = (
    "KHR_materials_sheen", "KHR_materials_anisotropy", "KHR_materials_iridescence", "KHR_materials_dispersion",
    "KHR_materials_volume",
)  # fmt: skip


def gltf_material(file: GltfFile, index: int, notes: list[str]) -> AssetMaterial:
    """Material number `index`; what is left out goes to `notes`.

    Raises:
        BrokenAsset: an image that cannot be read or lies outside the asset's folder.
    """
    entry = file.item("materials", index)
    name = str(entry.get("name") or f"material_{index}")
    surface, extensions = _object(entry, "pbrMetallicRoughness"), _object(entry, "extensions")
    factor = _numbers(surface, "baseColorFactor", (1.0, 1.0, 1.0, 1.0))
    base = _texture(file, surface.get("baseColorTexture"))
    packed = _texture(file, surface.get("metallicRoughnessTexture"))
    normal = _texture(file, entry.get("normalTexture"))
    if normal is not None and _number(_object(entry, "normalTexture"), "scale", 1.0) != 1.0:
        notes.append(f"material {name!r}: the scale of its normal map is taken for 1")
    mode = entry.get("alphaMode", "OPAQUE")
    material = AssetMaterial(
        name,
        base_color=(factor[0], factor[1], factor[2]),
        base_texture=base,
        roughness=_number(surface, "roughnessFactor", 1.0),
        roughness_texture=None if packed is None else replace(packed, channel=1),
        metallic=_number(surface, "metallicFactor", 1.0),
        metallic_texture=None if packed is None else replace(packed, channel=2),
        opacity=factor[3],
        opacity_texture=None if base is None else replace(base, channel=3),
        alpha_mode=mode if mode in ("MASK", "BLEND") else "OPAQUE",
        alpha_cutoff=_number(entry, "alphaCutoff", 0.5),
        normal_texture=normal,
        double_sided=bool(entry.get("doubleSided", False)),
        unlit="KHR_materials_unlit" in extensions,
    )
    material = _extended(file, material, extensions, notes)
    if any(value > 0 for value in _numbers(entry, "emissiveFactor", (0.0, 0.0, 0.0))):
        notes.append(f"material {name!r}: its glow (emissive) is left out")
    if "occlusionTexture" in entry:
        notes.append(f"material {name!r}: its occlusion map is left out; the renderer finds the shadows itself")
    left_out = [key.removeprefix("KHR_materials_") for key in _LEFT_OUT if key in extensions]
    if left_out:
        notes.append(f"material {name!r}: without {', '.join(left_out)}")
    return material


def _extended(file: GltfFile, material: AssetMaterial, extensions: dict[str, Any], notes: list[str]) -> AssetMaterial:
    glossy = _object(extensions, "KHR_materials_pbrSpecularGlossiness")
    if glossy:
        factor = _numbers(glossy, "diffuseFactor", (1.0, 1.0, 1.0, 1.0))
        base = _texture(file, glossy.get("diffuseTexture"))
        material = replace(
            material,
            base_color=(factor[0], factor[1], factor[2]),
            base_texture=base,
            opacity=factor[3],
            opacity_texture=None if base is None else replace(base, channel=3),
            roughness=1.0 - _number(glossy, "glossinessFactor", 1.0),
            metallic=0.0,
            roughness_texture=None,
            metallic_texture=None,
        )
        notes.append(f"material {material.name!r}: specular-glossiness is taken for a rough plastic of its colour")
    coat = _object(extensions, "KHR_materials_clearcoat")
    return replace(
        material,
        ior=max(_number(_object(extensions, "KHR_materials_ior"), "ior", 1.5), 1.0),
        specular=_number(_object(extensions, "KHR_materials_specular"), "specularFactor", 1.0),
        transmission=_number(_object(extensions, "KHR_materials_transmission"), "transmissionFactor", 0.0),
        clearcoat=_number(coat, "clearcoatFactor", 0.0),
        clearcoat_roughness=_number(coat, "clearcoatRoughnessFactor", 0.0),
    )


def _texture(file: GltfFile, info: object) -> Texture | None:
    if not isinstance(info, dict):
        return None
    entry = file.item("textures", info.get("index"))
    source = entry.get("source")
    webp = _object(_object(entry, "extensions"), "EXT_texture_webp").get("source")
    if source is None and webp is None:
        raise BrokenAsset("has a texture without an image that is read; export its images as PNG or JPEG")
    sampler = file.item("samplers", entry["sampler"]) if "sampler" in entry else {}
    transform = _object(_object(info, "extensions"), "KHR_texture_transform")
    uv_set = transform.get("texCoord", info.get("texCoord", 0))
    return Texture(
        file.image(source if source is not None else webp),
        to_uv=_to_uv(transform),
        wrap=_WRAPS.get(sampler.get("wrapS", 10497), "repeat"),
        nearest=sampler.get("magFilter") in _NEAREST,
        uv_set=uv_set if isinstance(uv_set, int) else 0,
    )


def _to_uv(transform: dict[str, Any]) -> np.ndarray:
    """offset + R(rotation) (scale * uv), as the extension has it: counter-clockwise in UVs whose v runs down."""
    offset, scale = _numbers(transform, "offset", (0.0, 0.0)), _numbers(transform, "scale", (1.0, 1.0))
    angle = _number(transform, "rotation", 0.0)
    cosine, sine = (1.0, 0.0) if angle == 0 else (math.cos(angle), math.sin(angle))
    turned = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([*scale, 1.0])
    turned[:2, 2] = offset
    return turned


def _object(parent: dict[str, Any], key: str) -> dict[str, Any]:
    found = parent.get(key)
    return found if isinstance(found, dict) else {}


def _number(parent: dict[str, Any], key: str, default: float) -> float:
    found = parent.get(key, default)
    return float(found) if isinstance(found, (int, float)) and not isinstance(found, bool) else default


def _numbers(parent: dict[str, Any], key: str, default: tuple[float, ...]) -> tuple[float, ...]:
    found = parent.get(key)
    if not isinstance(found, list) or len(found) != len(default):
        return default
    if not all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in found):
        return default
    return tuple(float(value) for value in found)
