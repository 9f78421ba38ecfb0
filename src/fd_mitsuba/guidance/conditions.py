"""What a network sees beside the noisy latents: the base, where on it, or with holes, or the surface for a ControlNet.

Which of them is told by the network's input channels, see `denoiser.Denoiser`.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.inpainting import masked_base, repaint_mask
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews, Phase
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.guidance.picture_latents import PictureLatents


class Conditions:
    """Makes them of a step's views.

    Args:
        latents: the pictures' way into the latents.
        config: settings of the model.
        view_grid: pictures are mosaics of view_grid x view_grid views.
        device: where the network runs.
        folder: of the model, for messages.
        inpaints, sees_region: as `denoiser.Denoiser` has them.
    """

    def __init__(
        self,
        latents: PictureLatents,
        config: GuidanceConfig,
        view_grid: int,
        device: torch.device,
        folder: Path,
        *,
        inpaints: bool,
        sees_region: bool,
    ) -> None:
        self._latents, self._config, self._view_grid = latents, config, view_grid
        self._device, self._folder = device, folder
        self._inpaints, self._sees_region = inpaints, sees_region

    def beside_latents(self, base: Tensor | None, where: Tensor | None, phase: Phase) -> Tensor | None:
        """What goes into the network together with z_t.

        Args:
            base: its pictures, or None.
            where: (N, 1, L, L) of `where`, or None.
            phase: whose pictures they are.
        """
        if base is None:
            return None
        if where is None:
            return self.seen_base(base, phase)
        return self.seen_around(base, where, phase) if self._inpaints else self.seen_there(base, where, phase)

    def where(self, views: GuidanceViews | AppearanceViews) -> Tensor | None:
        """(N, 1, L, L) `holes` for an inpainting model, `region` for one that is told it, None for others."""
        if self._inpaints:
            return self.holes(views)
        return self.region(views) if self._sees_region else None

    def region(self, views: GuidanceViews | AppearanceViews) -> Tensor:
        """(N, 1, L, L) in [0, 1]: the share of each cell in which a focal region is seen; zeros where none is told."""
        size, shares = self._latents.latent_size, sum(views.regions.values(), torch.zeros(()))
        if not views.regions:
            return torch.zeros(len(views.pictures) // self._view_grid**2, 1, size, size, device=self._device)
        return adaptive_avg_pool2d(tile_views(shares, self._view_grid), size).clamp(max=1).to(self._device)

    @torch.no_grad()
    def seen_base(self, base: Tensor, phase: Phase) -> Tensor:
        """The base's latents (N, 4, L, L) as InstructPix2Pix takes them: as the encoder gives them, not scaled."""
        return self._latents.unscaled(self._latents(base, phase))

    def seen_there(self, base: Tensor, region: Tensor, phase: Phase) -> Tensor:
        """(N, 5, L, L): the region, and the base's latents as `seen_base` has them."""
        return torch.cat([region, self.seen_base(base, phase)], dim=1)

    @torch.no_grad()
    def seen_around(self, base: Tensor, holes: Tensor, phase: Phase) -> Tensor:
        """(N, 5, L, L) as inpainting models take it: the holes, and the scaled latents of the base without them.

        Args:
            base: pictures of the base.
            holes: (N, 1, L, L), 1 where the model is to paint, 0 elsewhere.
            phase: whose pictures they are.
        """
        around = masked_base(base, holes, phase, self._latents.empty_mask(phase))
        return torch.cat([holes, self._latents(around, phase)], dim=1)

    def holes(self, views: GuidanceViews | AppearanceViews) -> Tensor:
        """(N, 1, L, L) where an inpainting model is to paint. Raises UserError where the views do not say it."""
        if not views.regions:
            raise UserError(
                f"{self._folder}: an inpainting model (9 input channels) is told by a mask what to paint, "
                "and the views come without one; give GuidanceViews.regions"
            )
        part_mask = views.part_mask if isinstance(views, AppearanceViews) else None
        size, margin = self._latents.latent_size, self._config.mask_margin
        return repaint_mask(views.regions, part_mask, self._view_grid, size, margin).to(self._device)

    def control(self, views: GuidanceViews | AppearanceViews, sees: str | None) -> Tensor | None:
        """(N, 3, H, H) for the ControlNet at the size of the VAE's input; None in the geometry stage.

        Args:
            views: with their `control`.
            sees: what it is shown; None: there is no ControlNet.
        """
        if sees is None or not isinstance(views, AppearanceViews):
            return None
        if views.control is None:
            raise ValueError(f"the ControlNet needs the surface's {sees} of the same views")
        return self._latents.resized(tile_views(views.control.detach(), self._view_grid).to(self._device).float())
