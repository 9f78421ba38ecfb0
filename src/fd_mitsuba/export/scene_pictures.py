"""Bitmap textures of a scene as picture files for other tools: byte for byte where these read them alike."""

from __future__ import annotations

from typing import Any

import numpy as np

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.pictures import Picture, packed_orm, png, srgb_from_linear
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

_SUFFIXES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg"}


def colour_picture(file: SceneFile, texture: SceneElement, name: str, notes: list[str]) -> Picture:
    """The texture as sRGB: the file itself where it is a PNG or JPEG that Mitsuba reads as sRGB too."""
    if not texture.properties.get("raw", False):
        original = _original(file, texture, f"{name}_base_color", notes)
        if original is not None:
            return original
    notes.append("the base colour's picture is converted to 8-bit sRGB")
    values = srgb_from_linear(_values(file, texture))
    return Picture(f"{name}_base_color", png(values), **_lookup(texture, notes))


def normal_picture(file: SceneFile, texture: SceneElement, name: str, notes: list[str]) -> Picture:
    """A normal map: the file itself where it is a PNG or JPEG that Mitsuba reads without decoding."""
    if texture.properties.get("raw", False):
        original = _original(file, texture, f"{name}_normal", notes)
        if original is not None:
            return original
    notes.append("the normal map's picture is converted to 8 bits")
    return Picture(f"{name}_normal", png(_values(file, texture)), **_lookup(texture, notes))


def grey_values(file: SceneFile, texture: SceneElement) -> np.ndarray:
    """What Mitsuba takes a bitmap for where it wants one number: (H, W, 1), the luminance of a coloured one."""
    values = _values(file, texture)
    if values.shape[-1] == 1:
        return values
    return np.einsum("hwc,c->hw", values[..., :3], [0.212671, 0.715160, 0.072169])[..., None]


def orm_picture(
    texture: SceneElement, roughness: np.ndarray | float, metallic: np.ndarray | float, name: str, notes: list[str]
) -> Picture:
    """Roughness and metallic, pictures (H, W, 1) or numbers, in one picture of the larger one's size."""
    arrays = [np.asarray(values, dtype=np.float64) for values in (roughness, metallic)]
    shapes = [array.shape[:2] for array in arrays if array.ndim]
    height, width = max(shape[0] for shape in shapes), max(shape[1] for shape in shapes)
    if len(set(shapes)) > 1:
        notes.append("roughness and metallic are brought to one size")
    whole = [_resized(array, height, width) for array in arrays]
    return Picture(f"{name}_orm", png(packed_orm(*whole)), **_lookup(texture, notes))


def _resized(values: np.ndarray, height: int, width: int) -> np.ndarray:
    if not values.ndim:
        return np.full((height, width, 1), float(values))
    rows = np.arange(height) * values.shape[0] // height
    columns = np.arange(width) * values.shape[1] // width
    return values[rows[:, None], columns[None, :]]


def _original(file: SceneFile, texture: SceneElement, name: str, notes: list[str]) -> Picture | None:
    data = _read(file, texture)
    suffix = next((suffix for magic, suffix in _SUFFIXES.items() if data.startswith(magic)), None)
    return None if suffix is None else Picture(name, data, suffix, **_lookup(texture, notes))


def _read(file: SceneFile, texture: SceneElement) -> bytes:
    path = file.resolve(texture.properties.get("filename", ""))
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read any more ({error.strerror}); put the file back") from None


def _values(file: SceneFile, texture: SceneElement) -> np.ndarray:
    """(H, W, 1 or 3) float as Mitsuba's shading sees them, row 0 at v = 0."""
    mi = file.mi
    _read(file, texture)
    path = file.resolve(texture.properties.get("filename", ""))
    try:
        with file_threads():
            bitmap = mi.Bitmap(str(path))
            if texture.properties.get("raw", False):
                bitmap.set_srgb_gamma(False)
            grey = bitmap.pixel_format() in (mi.Bitmap.PixelFormat.Y, mi.Bitmap.PixelFormat.YA)
            form = mi.Bitmap.PixelFormat.Y if grey else mi.Bitmap.PixelFormat.RGB
            bitmap = bitmap.convert(form, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise UserError(f"{path}: not a picture that Mitsuba reads ({' '.join(str(error).split())[:80]})") from None
    values = np.array(bitmap, dtype=np.float64)
    return values.reshape(values.shape[0], values.shape[1], -1)


def _lookup(texture: SceneElement, notes: list[str]) -> dict[str, Any]:
    properties = texture.properties
    transform = properties.get("to_uv")
    matrix = np.eye(4) if transform is None else np.array(getattr(transform, "matrix", transform), dtype=np.float64)
    scale, offset = (float(matrix[0, 0]), float(matrix[1, 1])), (float(matrix[0, 3]), float(matrix[1, 3]))
    if abs(matrix[0, 1]) + abs(matrix[1, 0]) > 1e-6:
        notes.append("without the rotation of its UVs")
    return {
        "wrap": str(properties.get("wrap_mode", "repeat")),
        "nearest": properties.get("filter_type", "bilinear") == "nearest",
        "tiling": (offset, scale),
    }
