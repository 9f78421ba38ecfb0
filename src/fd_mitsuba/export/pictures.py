"""Textures as picture files: 8-bit PNG for other tools, EXR for everything else."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.export.bake.bake import TextureSet
from fd_mitsuba.io.srgb import srgb_from_linear


@dataclass(frozen=True)
class Picture:
    """A picture file in memory, with how it is looked up.

    Attributes:
        name: file name without suffix.
        data: the file's bytes.
        suffix: ".png" or ".jpg".
        wrap: "repeat", "mirror" or "clamp".
        nearest: no filtering.
        tiling: offset (u, v) and scale (u, v): looked up at offset + scale * uv.
        rotation: radians by which scale * uv is turned first, as glTF's KHR_texture_transform means it.
    """

    name: str
    data: bytes
    suffix: str = ".png"
    wrap: str = "repeat"
    nearest: bool = False
    tiling: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (1.0, 1.0))
    rotation: float = 0.0

    @property
    def file_name(self) -> str:
        """Name with suffix."""
        return self.name + self.suffix

    @property
    def mime(self) -> str:
        """MIME type."""
        return "image/png" if self.suffix == ".png" else "image/jpeg"

    def pixels(self) -> np.ndarray:
        """(H, W, 3) uint8 as stored."""
        return np.asarray(Image.open(io.BytesIO(self.data)).convert("RGB"))

    def alpha(self) -> np.ndarray | None:
        """(H, W) uint8; None where it has none."""
        image = Image.open(io.BytesIO(self.data))
        if image.mode not in ("RGBA", "LA"):
            return None
        return np.asarray(image.getchannel("A"))


def png(values: np.ndarray) -> bytes:
    """An 8-bit PNG of values (H, W, 1 or 3) in [0, 1], rounded to the nearest step."""
    steps = np.round(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(steps[..., 0] if steps.shape[-1] == 1 else steps).save(stream, format="PNG", compress_level=4)
    return stream.getvalue()


def exr(mi: Any, values: np.ndarray) -> bytes:
    """A half-float EXR of values (H, W, 1 or 3); grey has the channel Y."""
    form = mi.Bitmap.PixelFormat.Y if values.shape[-1] == 1 else mi.Bitmap.PixelFormat.RGB
    bitmap = mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32), form)
    stream = mi.MemoryStream()
    with file_threads():
        bitmap.convert(component_format=mi.Struct.Type.Float16).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return stream.raw_buffer()


def packed_orm(roughness: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """glTF's metallic-roughness picture (H, W, 3): red is 1 (no occlusion), green roughness, blue metallic."""
    return np.concatenate([np.ones_like(roughness), roughness, metallic], axis=-1)


def part_pictures(name: str, textures: TextureSet) -> dict[str, Picture]:
    """The PNG pictures of a part: base_color (sRGB), orm, roughness, metallic, normal, normal_mitsuba (linear)."""
    values = {
        "base_color": srgb_from_linear(textures.base_color),
        "orm": packed_orm(textures.roughness, textures.metallic),
        "roughness": textures.roughness,
        "metallic": textures.metallic,
    }
    if textures.bends:
        values |= {"normal": 0.5 + 0.5 * textures.normal, "normal_mitsuba": 0.5 + 0.5 * textures.normal_mitsuba}
    return {key: Picture(f"{name}_{key}", png(value), wrap="clamp") for key, value in values.items()}
