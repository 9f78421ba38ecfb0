"""Materials of a 3DS file: diffuse colour, shininess, transparency, and the images of colour and opacity."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from fd_mitsuba.assets.asset import AssetMaterial, Texture, Wrap
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.images import found_beside, pixels, read_image
from fd_mitsuba.assets.threeds_chunks import chunks, number_of, text_of
from fd_mitsuba.io.srgb import linear_from_srgb

_NAME, _DIFFUSE, _SHININESS, _TRANSPARENCY, _TWO_SIDED = 0xA000, 0xA020, 0xA040, 0xA050, 0xA081
_COLOUR_MAP, _OPACITY_MAP = 0xA200, 0xA210
_OTHER_MAPS = {0xA230: "bump map", 0xA220: "reflection map", 0xA204: "specular map", 0xA33D: "glow"}
_FLOATS, _BYTES, _LINEAR_BYTES, _LINEAR_FLOATS = 0x0010, 0x0011, 0x0012, 0x0013
_PERCENT, _SHARE = 0x0030, 0x0031
_FILE, _TILING, _U_SCALE, _V_SCALE, _U_OFFSET, _V_OFFSET, _ANGLE = (
    0xA300, 0xA351, 0xA354, 0xA356, 0xA358, 0xA35A, 0xA35C,
)  # fmt: skip
_MIRROR, _ONCE = 0x02, 0x10
_LARGEST = 1e6
"""Of a scale, offset or angle that is one."""


def read_material(data: memoryview, folder: Path, notes: list[str]) -> AssetMaterial:
    """A material chunk; what is missing or left out goes to `notes`, a sentence each.

    Raises:
        BrokenAsset: it is cut short; an image that cannot be read.
    """
    found = AssetMaterial(base_color=(0.8, 0.8, 0.8))
    for kind, part in chunks(data):
        if kind == _NAME:
            found = replace(found, name=text_of(part)[0])
        elif kind == _DIFFUSE:
            found = replace(found, base_color=_colour(part))
        elif kind == _SHININESS:
            found = replace(found, roughness=1.0 - _share(part))
        elif kind == _TRANSPARENCY and (clear := _share(part)) > 0:
            found = replace(found, opacity=1.0 - clear, alpha_mode="BLEND")
        elif kind == _TWO_SIDED:
            found = replace(found, double_sided=True)
    for kind, part in chunks(data):  # whose messages have the material's name
        if kind in _OTHER_MAPS:
            notes.append(f"material {found.name!r}: its {_OTHER_MAPS[kind]} is left out")
        if kind not in (_COLOUR_MAP, _OPACITY_MAP) or (texture := _texture(part, folder, found.name, notes)) is None:
            continue
        if kind == _COLOUR_MAP:
            found = replace(found, base_texture=texture, base_color=(1.0, 1.0, 1.0))
        else:
            channel = 3 if pixels(texture.image).shape[2] == 4 else 0
            found = replace(found, opacity_texture=replace(texture, channel=channel), alpha_mode="BLEND")
    return found


def _colour(data: memoryview) -> tuple[float, float, float]:
    """Linear; a file may have the colour as shown and once more for a gamma of 1, of which the former counts."""
    known: dict[int, np.ndarray] = {}
    for kind, part in chunks(data):
        if kind in (_FLOATS, _LINEAR_FLOATS) and len(part) >= 12:
            with np.errstate(invalid="ignore"):
                known[kind] = np.frombuffer(part[:12], "<f4").astype(np.float64)
        elif kind in (_BYTES, _LINEAR_BYTES) and len(part) >= 3:
            known[kind] = np.frombuffer(part[:3], np.uint8) / 255.0
    for kind in (_FLOATS, _BYTES, _LINEAR_FLOATS, _LINEAR_BYTES):
        if kind in known and np.isfinite(known[kind]).all():
            shown = np.clip(known[kind], 0, 1)
            red, green, blue = (linear_from_srgb(shown) if kind in (_FLOATS, _BYTES) else shown).tolist()
            return red, green, blue
    return 0.8, 0.8, 0.8


def _share(data: memoryview) -> float:
    """A percentage as a number in [0, 1]."""
    for kind, part in chunks(data):
        if kind == _PERCENT:
            return float(np.clip(number_of(part, "<h") / 100, 0, 1))
        if kind == _SHARE:
            return float(np.clip(np.nan_to_num(number_of(part, "<f")), 0, 1))
    return 0.0


def _texture(data: memoryview, folder: Path, material: str, notes: list[str]) -> Texture | None:
    name, flags = "", 0
    numbers = {_U_SCALE: 1.0, _V_SCALE: 1.0, _U_OFFSET: 0.0, _V_OFFSET: 0.0, _ANGLE: 0.0}
    for kind, part in chunks(data):
        if kind == _FILE:
            name = text_of(part)[0]
        elif kind == _TILING:
            flags = int(number_of(part, "<H"))
        elif kind in numbers and abs(value := number_of(part, "<f")) < _LARGEST:
            numbers[kind] = value
    if not name:
        return None
    path = _place(folder, name)
    if path is None:
        notes.append(f"material {material!r}: its image {name[:60]!r} is not beside the file and is left out")
        return None
    try:
        image = read_image(path)
    except BrokenAsset as error:
        raise BrokenAsset(f"material {material!r}: {error}") from None
    scale = np.diag([numbers[_U_SCALE] or 1.0, numbers[_V_SCALE] or 1.0, 1.0])
    turn, flip = np.eye(3), np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
    angle = np.radians(numbers[_ANGLE])
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:2, 2] = numbers[_U_OFFSET], numbers[_V_OFFSET]
    wrap: Wrap = "mirror" if flags & _MIRROR else "clamp" if flags & _ONCE else "repeat"
    return Texture(image, flip @ turn @ scale @ flip, wrap)  # there, v runs upwards


def _place(folder: Path, name: str) -> Path | None:
    """The image beside the file; names are of a time when A and a were the same."""
    if (found := found_beside(folder, name)) is not None:
        return found
    last = PurePosixPath(name.replace("\\", "/")).name.lower()
    alike = (path.name for path in sorted(folder.iterdir()) if path.name.lower() == last)
    return next((place for other in alike if (place := found_beside(folder, other)) is not None), None)
