"""What ControlNets are shown of the present surface: its normals or its depth in the views, as colours."""

from __future__ import annotations

from typing import Literal

import drjit as dr
import mitsuba as mi
import torch
from torch import Tensor

from fd_mitsuba.backend import bridge
from fd_mitsuba.render.gbuffer import GBuffer, Samples

SurfaceKind = Literal["depth", "normal"]
_BACKGROUND = {"depth": (0.0, 0.0, 0.0), "normal": (0.5, 0.5, 1.0)}


def surface_views(gbuffer: GBuffer, kind: SurfaceKind) -> Tensor:
    """(B, 3, S, S) in [0, 1], constant, of base and part together.

    depth: 1 / z of each pixel over the view's largest, in all channels: near is white, what is endlessly far is black,
        as MiDaS estimates it.
    normal: (1 - n_right, 1 + n_up, 1 + n_to_camera) / 2 in the camera's frame, the background facing the camera: red
        is left, green is up, blue is to the front.
    """
    with dr.suspend_grad():
        seen = [_values(gbuffer, samples, kind) for samples in (gbuffer.base_samples, gbuffer.part_samples)]
    size = gbuffer.views.size
    total = sum(seen, torch.zeros(())).reshape(3, gbuffer.views.count, size, size).transpose(0, 1)
    if kind == "depth":
        total = total / total.amax(dim=(1, 2, 3), keepdim=True).clamp(min=torch.finfo(total.dtype).tiny)
    background = torch.tensor(_BACKGROUND[kind]).view(1, 3, 1, 1)
    return total + (1 - gbuffer.alpha) * background


def _values(gbuffer: GBuffer, samples: Samples, kind: SurfaceKind) -> Tensor:
    """Three channels after another, multiplied by the samples' coverage."""
    if not len(samples):
        return torch.zeros(3 * gbuffer.pixels)
    ray = gbuffer.rays(samples)
    camera = gbuffer.views.at(samples.lane // (gbuffer.spp * gbuffer.views.size**2))
    if kind == "depth":
        colour = mi.Color3f(dr.rcp(-samples.hit.t * dr.dot(ray.d, camera.back)))
    else:
        surface = samples.hit.compute_surface_interaction(ray, mi.RayFlags.All)
        normal = mi.Vector3f(surface.sh_frame.n)
        normal = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
        axes = [dr.dot(normal, axis) for axis in (camera.right, camera.up, camera.back)]
        colour = mi.Color3f(1 - axes[0], 1 + axes[1], 1 + axes[2]) / 2
    return bridge.to_torch(dr.concat(gbuffer.picture(samples, colour)))
