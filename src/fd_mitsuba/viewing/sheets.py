"""What a step looks like: rows of pictures for people, made only when a contact sheet is due."""

from __future__ import annotations

import numpy as np
from PIL import Image
from torch import Tensor, cat, zeros

from fd_mitsuba.fields.texture import TextureValues
from fd_mitsuba.render.appearance_pass import AppearancePictures
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.render.tonemap import to_srgb

_LEAST_WIDTH = 512


def geometry_sheet(pictures: Tensor, preview: Tensor | None) -> np.ndarray | None:
    """Normals and part masks of the views (B, 5, H, W), and below them the guidance's estimate; None without views."""
    if not len(pictures):
        return None
    rows = [np.concatenate(list(normal_pictures(pictures)), axis=1)]
    mask = pictures[:, 4].clamp(0, 1).numpy()
    rows.append(np.repeat(np.concatenate(list((mask * 255).astype(np.uint8)), axis=1)[..., None], 3, axis=2))
    if preview is not None:
        # Latents are read as (normal, 2 mask - 1), which is what they are for the built-in prior.
        latents = preview.float().cpu()
        guess = cat([latents[:, :3], (latents[:, 3:4] + 1) / 2], dim=1)
        rows.append(np.concatenate(list(normal_pictures(guess)), axis=1))
    return stacked(rows)


def stacked(rows: list[np.ndarray]) -> np.ndarray:
    """Rows (H, W, 3) uint8 below each other at the first one's width, enlarged in whole steps to be seen well."""
    width = rows[0].shape[1] * max(1, round(_LEAST_WIDTH / rows[0].shape[1]))
    scaled = []
    for row in rows:
        size = (width, max(1, round(row.shape[0] * width / row.shape[1])))
        scaled.append(np.asarray(Image.fromarray(row).resize(size, Image.Resampling.NEAREST)))
    return np.concatenate(scaled, axis=0)


def normal_pictures(pictures: Tensor) -> np.ndarray:
    """Colours (B, H, W, 3) uint8 of geometry pictures (B, >=4, H, W): (n + 1) / 2 on covered pixels over black."""
    normal, mask = pictures[:, :3], pictures[:, 3:4]
    colour = ((normal + mask) / 2).clamp(0, 1).permute(0, 2, 3, 1)
    return (colour.numpy() * 255 + 0.5).astype(np.uint8)


def appearance_sheet(
    gbuffer: GBuffer, pictures: AppearancePictures, texture: TextureValues, exposure: float, preview: Tensor | None
) -> np.ndarray:
    """Rows of `map_rows`, and below them the guidance's estimate."""
    rows = [np.concatenate(list(row), axis=1) for row in map_rows(gbuffer, pictures, texture, exposure).values()]
    if preview is not None:
        # Latents are read as 2 sRGB - 1, which is what they are for the built-in prior.
        rows.append(np.concatenate(list(as_bytes((preview[:, :3].float().cpu() + 1) / 2)), axis=1))
    return stacked(rows)


def map_rows(gbuffer: GBuffer, pictures: AppearancePictures, texture: TextureValues, exposure: float) -> dict:
    """Captioned rows (B, S, S, 3) uint8: merged, base path, part path, mask, and the field's maps."""
    shown = {
        "merged": to_srgb(pictures.merged * exposure),
        "base path": to_srgb(pictures.base_path * exposure),
        "part path": to_srgb(pictures.part_path * exposure),
        "part mask": pictures.part_mask.expand(-1, 3, -1, -1),
        "kd": to_srgb(on_film(gbuffer, texture.base_color)),
        "roughness": on_film(gbuffer, texture.roughness),
        "metallic": on_film(gbuffer, texture.metallic),
        "kn": on_film(gbuffer, (texture.normal + 1) / 2),
    }
    return {name: as_bytes(picture) for name, picture in shown.items()}


def on_film(gbuffer: GBuffer, values: Tensor) -> Tensor:
    """(B, 3, S, S) of values (N, 1 or 3) at the G-buffer's points; black elsewhere."""
    views, size = gbuffer.views.count, gbuffer.views.size
    film = zeros(views * size * size, 3)
    film[gbuffer.pixel] = values.detach().expand(-1, 3).float()
    return film.reshape(views, size, size, 3).permute(0, 3, 1, 2)


def as_bytes(pictures: Tensor) -> np.ndarray:
    """(B, H, W, 3) uint8 of pictures (B, 3, H, W) in [0, 1]."""
    return (pictures.detach().clamp(0, 1).permute(0, 2, 3, 1).numpy() * 255 + 0.5).astype(np.uint8)
