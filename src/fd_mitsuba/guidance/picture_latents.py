"""From pictures to a pipeline's latents: normals and mask as they are, or pictures through its VAE."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.guidance.colour_latents import colour_latents
from fd_mitsuba.guidance.interface import Phase
from fd_mitsuba.guidance.model_conventions import ModelConventions

BACKGROUNDS = {"black": -1.0, "grey": 0.0, "white": 1.0}
"""What the VAE is given beside the object in the refined phase."""


class PictureLatents:
    """The pictures' way into the latents, with gradients.

    In the coarse phase (normal times coverage, mask) stands for scaled latents; in the refined phase the normals, as
    colours on `refined_background`, go through the VAE encoder (its mean: only t and the noise are random), and so do
    the colours of the appearance stage, unless the model's conventions say `area_mean_shine`.
    """

    def __init__(self, vae: Any, conventions: ModelConventions, config: GuidanceConfig, latent_size: int) -> None:
        settings = vae.config
        self.vae, self.latent_size = vae, latent_size
        self.sees_shine = conventions.latents == "area_mean_shine"
        self.vae_scale_factor = 2 ** (
            len(settings.get("encoder_block_out_channels") or settings.block_out_channels) - 1
        )
        self.scaling_factor = float(settings.get("scaling_factor", 1.0))
        self.shift_factor = float(settings.get("shift_factor") or 0.0)
        auto = "signed" if conventions.is_packed else "unit"
        self.signed_mask = (auto if config.mask_channel == "auto" else config.mask_channel) == "signed"
        self.background = BACKGROUNDS[config.refined_background]

    @property
    def picture_side(self) -> int:
        """Pixels a side of what the VAE takes."""
        return self.latent_size * self.vae_scale_factor

    def __call__(self, images: Tensor, phase: Phase) -> Tensor:
        """Scaled latents z (N, 4, L, L) of pictures or mosaics.

        Of geometry pictures (N, 5, H, H), coarse: (n coverage, mask), the mask in [0, 1] or as 2 mask - 1; refined:
        scaling_factor (E(n coverage + background (1 - mask)) - shift_factor). Of colours c (N, 3, H, H): the same with
        E(2 c - 1), or `colour_latents` of colours and shine (N, 4, H, H).
        """
        if phase == "appearance":
            if self.sees_shine:
                return colour_latents(images.float(), self.latent_size)
            return self._through_vae(2 * self.resized(images.float()) - 1)
        normal, mask = images[:, :3], images[:, 3:4]
        if phase == "coarse":
            return torch.cat([normal, 2 * mask - 1 if self.signed_mask else mask], dim=1).float()
        # (n + 1) / 2 on covered pixels is the colour of a normal n of length 1; the VAE takes twice that less 1.
        if self.background == BACKGROUNDS["black"]:
            return self._through_vae((normal + mask - 1).float())
        return self._through_vae((normal + self.background * (1 - mask)).float())

    def resized(self, pictures: Tensor) -> Tensor:
        """Pictures (N, 3, H, H) at the size that the VAE takes."""
        side = self.picture_side
        if pictures.shape[-1] == side:
            return pictures
        return interpolate(pictures, size=(side, side), mode="bilinear", antialias=True)

    def unscaled(self, latents: Tensor) -> Tensor:
        """Latents as the encoder gives them."""
        return latents / self.scaling_factor + self.shift_factor

    def coverage(self, latents: Tensor) -> Tensor:
        """(N, 1, L, L) the mask that latents of the coarse phase hold; in [0, 1] for those of pictures."""
        return (latents[:, 3:4] + 1) / 2 if self.signed_mask else latents[:, 3:4]

    def empty_mask(self, phase: Phase) -> float:
        """The mask at which a picture without normals has latents, or a VAE's input, of 0."""
        if phase == "coarse":
            return 0.5 if self.signed_mask else 0.0
        return 1.0

    def _through_vae(self, pictures: Tensor) -> Tensor:
        encoded = self.vae.encode(pictures)
        latents = encoded.latents if hasattr(encoded, "latents") else encoded.latent_dist.mean
        return (latents - self.shift_factor) * self.scaling_factor
