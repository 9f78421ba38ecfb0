"""Lit pictures of a finished part for people: turntables, contact sheets, and the maps behind them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.viewing.sheets import as_bytes

VIEWS_AT_ONCE = 4
_ENOUGH = 32
"""Samples of a pixel that can be shared by four: fewer are better spread over one pixel by themselves."""
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
    shade: Callable[[GBuffer, int], Tensor],
    cameras: CameraBatch,
    exposure: float,
    size: int,
    spp: int,
    seed: int = 0,
) -> np.ndarray:
    """sRGB pictures (B, size, size, 3) uint8 over grey.

    The fields are asked once a pixel, which a smooth metal shows as blotches. So where samples are many, four finer
    pixels are traced in the place of one.

    Args:
        shade: a G-buffer and a seed -> linear pictures (b, 3, size, size), multiplied by coverage.
    """
    frames, finer = [], 2 if spp >= _ENOUGH else 1
    for start in range(0, len(cameras), VIEWS_AT_ONCE):
        few = some_cameras(cameras, slice(start, start + VIEWS_AT_ONCE))
        gbuffer = rendering.trace(few, seed + start, size=size * finer, spp=spp // finer**2)
        linear = shade(gbuffer, seed + start) * exposure + _BACKGROUND * (1 - gbuffer.alpha)
        frames.append(as_bytes(to_srgb(avg_pool2d(linear, finer))))
    return np.concatenate(frames)
