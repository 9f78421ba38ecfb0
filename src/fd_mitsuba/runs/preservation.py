"""How much the base's pixels change when the part is there: not at all, where no light is taken or added by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from scipy.spatial import ConvexHull

from fd_mitsuba.backend.startup import VERTICES
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.gbuffer import GBuffer, Samples
from fd_mitsuba.scene.views import CameraBatch

MOST_DECIBELS = 200.0
"""What equal images are given, so that the metric stays a number in JSON."""

_POINTS_AT_ONCE = 16384
_PRODUCTS_AT_ONCE = 1 << 24
"""Of a point and a corner; a part that is still its region has thousands of corners."""


@dataclass(frozen=True)
class BasePreservation:
    """Attributes:
    base_psnr_db: over pixels that show nothing but the base and whose light the part does not touch, of linear
        radiance after exposure; `MOST_DECIBELS` where they are equal.
    untouched_share: how much of the base's pixels that are.
    mask_error: the largest difference between alpha and the sum of the two sides of the mask, each side counted from
        the samples that its path shades: one that both shade, or neither, would show here.
    """

    base_psnr_db: float
    untouched_share: float
    mask_error: float


@torch.no_grad()
def measure_preservation(
    with_part: AppearancePass,
    alone: AppearancePass,
    cameras: CameraBatch,
    exposure: float,
    size: int,
    spp: int,
    solids: Sequence[np.ndarray] | None = None,
) -> BasePreservation:
    """Compare the base path with the render of the base alone, at equal seeds.

    Args:
        with_part, alone: passes of the same scene, the second without any part.
        solids: vertices (V, 3), in the frame of the renders, of what takes or sends light; None: the parts of the first
            pass. Where parts were cut out, these are what is gone.
    """
    edited, base = (rendering.trace(cameras, 0, size=size, spp=spp) for rendering in (with_part, alone))
    pair = with_part.render_base(edited, 0) * exposure, alone.render_base(base, 0) * exposure
    whole = (edited.base_mask > 0.999) & (base.base_mask > 0.999)
    touched = light_may_be_touched(edited, solids or [_vertices(part) for part in with_part.scene.parts])
    counted = (whole & ~touched).expand(-1, 3, -1, -1)
    error = float((pair[0] - pair[1])[counted].square().mean()) if counted.any() else 0.0
    decibels = MOST_DECIBELS if error == 0 else min(-10 * float(np.log10(error)), MOST_DECIBELS)
    sides = _share(edited, edited.part_samples) + _share(edited, edited.base_samples)
    share = float((whole & ~touched).sum() / max(int(whole.sum()), 1))
    return BasePreservation(decibels, share, float((edited.alpha - sides).abs().max()))


def light_may_be_touched(gbuffer: GBuffer, solids: Sequence[np.ndarray]) -> torch.Tensor:
    """(B, 1, S, S) bool: pixels with a base sample over whose horizon some of a solid (V, 3) rises, so that it may take
    or send light there. Of an opaque base all others are lit as without the solids, if light does not bounce."""
    views, size, samples = gbuffer.views.count, gbuffer.views.size, gbuffer.base_samples
    touched = np.zeros(views * size * size, dtype=bool)
    if len(samples):
        ray = gbuffer.rays(samples)
        surface = samples.hit.compute_surface_interaction(ray, mi.RayFlags.All)
        facing = dr.mulsign(mi.Vector3f(surface.n), dr.dot(surface.n, -ray.d))
        points, normals = np.array(surface.p).T.astype(np.float64), np.array(facing).T.astype(np.float64)
        corners = np.concatenate([vertices[ConvexHull(vertices).vertices] for vertices in solids])
        height = -np.einsum("ij,ij->i", normals, points)
        together = max(256, min(_POINTS_AT_ONCE, _PRODUCTS_AT_ONCE // max(len(corners), 1)))
        for start in range(0, len(points), together):
            some = slice(start, start + together)
            height[some] += (normals[some] @ corners.T).max(axis=1)
        touched[np.array(samples.lane)[height > 0] // gbuffer.spp] = True
    return torch.from_numpy(touched).reshape(views, 1, size, size)


def _share(gbuffer: GBuffer, samples: Samples) -> torch.Tensor:
    """(B, 1, S, S): how many of each pixel's samples are among `samples`, as a share."""
    pixel = np.array(samples.lane, dtype=np.int64) // gbuffer.spp
    counts = torch.from_numpy(np.bincount(pixel, minlength=gbuffer.pixels))
    return (counts.float() / gbuffer.spp).view_as(gbuffer.alpha)


def _vertices(part: mi.Mesh) -> np.ndarray:
    return np.array(mi.traverse(part)[VERTICES], dtype=np.float64).reshape(-1, 3)
