"""MTL files: the materials of an OBJ, with the names that exporters of physically based materials have added."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fd_mitsuba.assets.asset import AssetMaterial, Texture, TextureImage
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.images import found_beside, pixels, read_image
from fd_mitsuba.io.regular_file import NotReadable, read_regular

_MOST_BYTES = 1 << 26
_OPTIONS = {"-blendu": 1, "-blendv": 1, "-bm": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-mm": 2}
_OPTIONS |= {"-texres": 1, "-type": 1}
_VECTORS = ("-o", "-s", "-t")


def read_mtl(path: Path, notes: list[str]) -> dict[str, AssetMaterial]:
    """Name -> material. What is missing or left out goes to `notes`, a sentence each.

    Colours are taken as they are, linear; the classic shininess `Ns` becomes a roughness where `Pr` does not give one.
    """
    try:
        text = read_regular(path, _MOST_BYTES).decode("utf-8-sig", errors="replace")
    except NotReadable as error:
        notes.append(f"its material file {path.name!r} {error}, so that the mesh is grey; keep it beside the OBJ")
        return {}
    found: dict[str, AssetMaterial] = {}
    current = ""
    images: dict[Path, TextureImage] = {}
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        key, values = words[0].lower(), words[1:]
        if key == "newmtl":
            current = " ".join(values)
            found[current] = AssetMaterial(current, base_color=(0.8, 0.8, 0.8))
        elif current:
            found[current] = _changed(found[current], key, values, path.parent, images, notes)
    return found


def _changed(
    material: AssetMaterial,
    key: str,
    values: list[str],
    folder: Path,
    images: dict[Path, TextureImage],
    notes: list[str],
) -> AssetMaterial:
    numbers = _numbers(values)
    if key == "kd" and numbers:
        colour = numbers[:3] if len(numbers) >= 3 else numbers[:1] * 3
        return replace(material, base_color=tuple(float(np.clip(value, 0, 1)) for value in colour))
    if key in ("d", "tr") and numbers:
        opacity = float(np.clip(numbers[0] if key == "d" else 1 - numbers[0], 0, 1))
        mode = "BLEND" if opacity < 1 else material.alpha_mode
        return replace(material, opacity=opacity, alpha_mode=mode)
    if key == "ns" and numbers:  # Blender writes 1000 (1 - roughness)^2; without Pr
        return replace(material, roughness=float(1 - np.sqrt(np.clip(numbers[0] / 1000, 0, 1))))
    if key in ("pr", "pm") and numbers:
        field = "roughness" if key == "pr" else "metallic"
        return replace(material, **{field: float(np.clip(numbers[0], 0, 1))})
    if key == "ni" and numbers and 1 <= numbers[0] <= 4:
        return replace(material, ior=float(numbers[0]))
    fields = {
        "map_kd": "base_texture", "map_pr": "roughness_texture", "map_pm": "metallic_texture", "norm": "normal_texture",
        "map_d": "opacity_texture",
    }  # fmt: skip
    if key in ("map_bump", "bump"):
        notes.append(f"material {material.name!r}: its bump map is left out; a normal map (norm) is read")
    if key not in fields:
        return material
    texture = _texture(values, folder, images, notes, material.name)
    if texture is None:
        return material
    if key == "map_kd":
        # In the format the two are multiplied; exporters write a colour beside a map that no program shows.
        return replace(material, base_texture=texture, base_color=(1.0, 1.0, 1.0))
    if key == "map_d":
        texture = replace(texture, channel=3 if pixels(texture.image).shape[2] == 4 else 0)
        return replace(material, opacity_texture=texture, alpha_mode="BLEND")
    if key in ("map_pr", "map_pm"):
        name = "roughness" if key == "map_pr" else "metallic"
        material = replace(material, **{name: 1.0})
        texture = replace(texture, channel=0)
    return replace(material, **{fields[key]: texture})


def _texture(
    words: list[str], folder: Path, images: dict[Path, TextureImage], notes: list[str], material: str
) -> Texture | None:
    offset, scale, clamp, place = [0.0, 0.0], [1.0, 1.0], False, 0
    while place < len(words) and words[place].startswith("-") and len(words[place]) > 1:
        option = words[place].lower()
        place += 1
        if option in _VECTORS:
            values = []
            while place < len(words) - 1 and len(values) < 3 and _numbers([words[place]]):
                values += _numbers([words[place]])
                place += 1
            if option == "-o":
                offset[: len(values[:2])] = values[:2]
            elif option == "-s":
                scale[: len(values[:2])] = values[:2]
        elif option in _OPTIONS:
            clamp = clamp or (option == "-clamp" and words[place : place + 1] == ["on"])
            place += _OPTIONS[option]
        else:
            place -= 1
            break
    name = " ".join(words[place:])
    if not name:
        return None
    path = found_beside(folder, name)
    if path is None:
        notes.append(f"material {material!r}: its image {name[:60]!r} is not beside the OBJ and is left out")
        return None
    try:
        images[path] = images.get(path) or read_image(path)
    except BrokenAsset as error:
        raise BrokenAsset(f"material {material!r}: {error}") from None
    # v runs upwards in an OBJ: v' = s v + o is s v + (1 - s - o) with v from the top.
    to_uv = np.array([[scale[0], 0, offset[0]], [0, scale[1], 1 - scale[1] - offset[1]], [0, 0, 1.0]])
    return Texture(images[path], to_uv, "clamp" if clamp else "repeat")


def _numbers(words: list[str]) -> list[float]:
    found = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            break
        if np.isfinite(value):
            found.append(value)
    return found
