"""Bitmap textures of a scene as picture files for other tools: byte for byte where these read them alike."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.pictures import Picture, packed_orm, png
from fd_mitsuba.io.srgb import srgb_from_linear
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


def opacity_picture(
    file: SceneFile, texture: SceneElement, colours: Picture | None, name: str, notes: list[str]
) -> tuple[Picture, bool]:
    """A base colour picture with a bitmap of opacities as its alpha, and whether these are 0 and 1 alone.

    The picture itself, byte for byte, where its own alpha says the same.

    Args:
        colours: the base colours so far; None: white.
    """
    alpha = np.round(np.clip(grey_values(file, texture)[..., 0], 0, 1) * 255).astype(np.uint8)
    is_cut = bool(((alpha == 0) | (alpha == 255)).all())
    look = _lookup(texture, notes)
    if colours is None:
        return Picture(f"{name}_base_color", rgba_png(np.full((1, 1, 3), 255, np.uint8), alpha), **look), is_cut
    own = colours.alpha()
    if own is not None and own.shape == alpha.shape:
        cut = np.where(own >= 128, 255, 0)
        if np.array_equal(own, alpha) or (is_cut and np.array_equal(cut, alpha)):
            return colours, is_cut
    if (colours.tiling, colours.rotation) != (look["tiling"], look["rotation"]):
        notes.append("its opacity is taken to lie as its base colour does")
    notes.append("the base colour's picture is written anew, with its opacity as alpha")
    return replace(colours, data=rgba_png(colours.pixels(), alpha), suffix=".png"), is_cut


def rgba_png(colours: np.ndarray, alpha: np.ndarray) -> bytes:
    """A PNG of colours (H, W, 3) and alpha (h, w) in bytes, as large as the larger one."""
    height, width = max(colours.shape[0], alpha.shape[0]), max(colours.shape[1], alpha.shape[1])
    whole = [_resized(values, height, width) for values in (colours, alpha[..., None])]
    stream = io.BytesIO()
    Image.fromarray(np.concatenate(whole, axis=2).astype(np.uint8)).save(stream, format="PNG", compress_level=4)
    return stream.getvalue()


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
    scale, rotation = _scale_and_rotation(matrix[:2, :2], notes)
    offset = (float(matrix[0, 3]), float(matrix[1, 3]))
    return {
        "wrap": str(properties.get("wrap_mode", "repeat")),
        "nearest": properties.get("filter_type", "bilinear") == "nearest",
        "tiling": (offset, scale),
        "rotation": rotation,
    }


def _scale_and_rotation(matrix: np.ndarray, notes: list[str]) -> tuple[tuple[float, float], float]:
    """Scales along u and v, and the rotation after them, of a map (2, 2) of UVs; a shear is left out."""
    (a, b), (c, d) = matrix.tolist()
    if abs(b) + abs(c) <= 1e-6:
        return (a, d), 0.0
    angle = float(np.arctan2(-c, a))
    cosine, sine = np.cos(angle), np.sin(angle)
    along_u, along_v = float(np.hypot(a, c)), float(b * sine + d * cosine)
    if abs(b - sine * along_v) + abs(d - cosine * along_v) > 1e-5 * max(abs(b), abs(d)):
        notes.append("without the shear of its UVs")
    return (along_u, along_v), angle
