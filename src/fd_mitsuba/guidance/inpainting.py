"""What an inpainting model is told: a mask of what to paint, and the base with mid-grey there.

Both as diffusers' `StableDiffusionInpaintPipeline` makes them: the mask is 1 where the model paints, at the latents'
size, and the masked picture is 0 there, in a range of -1 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate, max_pool2d

from fd_mitsuba.guidance.interface import Phase
from fd_mitsuba.guidance.mosaic import tile_views


def repaint_mask(
    regions: Mapping[str, Tensor], part_mask: Tensor | None, view_grid: int, latent_size: int, margin: int
) -> Tensor:
    """(N, 1, L, L) of zeros and ones: where any region is seen, or the part itself, and `margin` cells around.

    Args:
        regions: part -> (B, 1, R, R), as `GuidanceViews.regions`; not empty.
        part_mask: (B, 1, H, H), the part's coverage, so that nothing of it is taken for the base; None: regions alone.
        view_grid: the N pictures are mosaics of view_grid x view_grid views.
    """
    covered = adaptive_avg_pool2d(tile_views(sum(regions.values(), torch.zeros(())), view_grid), latent_size)
    if part_mask is not None:
        covered = covered + adaptive_avg_pool2d(tile_views(part_mask.detach(), view_grid), latent_size)
    return max_pool2d((covered > 0).float(), 2 * margin + 1, stride=1, padding=margin)


def masked_base(base: Tensor, holes: Tensor, phase: Phase, empty_mask: float) -> Tensor:
    """The base's pictures, of which `encode` makes latents or colours that are 0 in the holes.

    Args:
        base: (N, 5, H, H) geometry pictures or (N, 3, H, H) colours in [0, 1].
        holes: (N, 1, L, L) of zeros and ones.
        empty_mask: `PictureLatents.empty_mask` of the phase.
    """
    hole = interpolate(holes, size=base.shape[-2:], mode="nearest")
    if phase == "appearance":
        return base * (1 - hole) + 0.5 * hole
    normal, mask = base[:, :3] * (1 - hole), base[:, 3:] * (1 - hole) + empty_mask * hole
    return torch.cat([normal, mask], dim=1)
