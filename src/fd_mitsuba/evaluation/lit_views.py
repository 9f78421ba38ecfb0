"""Lit pictures of a finished part for people: turntables, contact sheets, and the maps behind them."""

from __future__ import annotations

import numpy as np
import torch

from fd_mitsuba.fields.texture import TextureField, TextureValues
from fd_mitsuba.render.appearance_pass import AppearancePass, AppearancePictures
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.sheets import as_bytes

_VIEWS_AT_ONCE = 4
_BACKGROUND = 0.35


def ring_cameras(count: int, aim: np.ndarray, elevation_deg: float = 20.0) -> CameraBatch:
    """Cameras around `aim`, front first, as the normal-map turntable has them."""
    return CameraBatch.around(np.arange(count) * (360.0 / count), elevation_deg, 3.4, 45.0, np.tile(aim, (count, 1)))


def some_cameras(cameras: CameraBatch, rows: slice) -> CameraBatch:
    """A part of a batch."""
    names = ("position", "target", "fov_deg", "azimuth_deg", "elevation_deg")
    return CameraBatch(**{name: getattr(cameras, name)[rows] for name in names})


@torch.no_grad()
def lit_ring(
    rendering: AppearancePass,
    field: TextureField | None,
    bends: bool,
    cameras: CameraBatch,
    exposure: float,
    size: int,
    spp: int,
    seed: int = 0,
) -> np.ndarray:
    """sRGB pictures (B, size, size, 3) uint8 over grey.

    Args:
        field: None renders the base path alone: `rendering` may then have no parts.
        bends: whether the field's normal is used.
    """
    frames = []
    for start in range(0, len(cameras), _VIEWS_AT_ONCE):
        few = some_cameras(cameras, slice(start, start + _VIEWS_AT_ONCE))
        gbuffer = rendering.trace(few, seed + start, size=size, spp=spp)
        if field is None:
            linear = rendering.render_base(gbuffer, seed + start)
        else:
            linear = render_field(rendering, field, bends, gbuffer, seed + start)[0].merged
        finished = to_srgb(linear * exposure + _BACKGROUND * (1 - gbuffer.alpha))
        frames.append(as_bytes(finished))
    return np.concatenate(frames)


def render_field(
    rendering: AppearancePass, field: TextureField, bends: bool, gbuffer: GBuffer, seed: int
) -> tuple[AppearancePictures, TextureValues]:
    """Pictures of a traced batch with the field's material, and the material at the G-buffer's points."""
    texture = field(gbuffer.points)
    normal = texture.normal if bends else None
    pictures = rendering.render(gbuffer, texture.base_color, texture.roughness, texture.metallic, normal, seed=seed)
    return pictures, texture
