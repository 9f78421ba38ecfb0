"""From noisy latents to the guidance gradient: a UNet's passes, put together as `sds` says. Knows no pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.layout import latent_side
from fd_mitsuba.guidance.loading import Components

RECONSTRUCTION_STEPS = 4
"""DDIM steps from z_t down to the clean latents, for the variant `reconstruction`."""


@dataclass(frozen=True)
class Distillation:
    """How the gradient is made in one phase; the names are those of the settings."""

    variant: Literal["sds", "csd", "reconstruction"]
    weighting: sds.Weighting
    guidance_scale: float
    image_guidance_scale: float
    timestep_range: tuple[float, float]


@dataclass(frozen=True)
class Chunk:
    """What the network needs for some pictures: all (n, ...), on its device, without gradients.

    `mask` (n, 1, L, L) of zeros and ones confines noise and gradient; None: they are everywhere.
    """

    z: Tensor
    noise: Tensor
    timesteps: Tensor
    texts: dict[str, Tensor]
    condition: Tensor | None
    mask: Tensor | None


class Denoiser:
    """The UNet with its noise schedule.

    A UNet with 8 input channels sees a condition's latents beside z_t (`needs_base`).
    """

    def __init__(self, components: Components, config: GuidanceConfig, device: str = "cpu") -> None:
        self.config = config
        self.components = components
        self.device = torch.device(device)
        self.needs_base = components.unet.config.in_channels == 8
        self.latent_size = latent_side(components.unet.config)
        self.alpha_bars = components.scheduler.alphas_cumprod.to(device=self.device, dtype=torch.float32)
        self.prediction_type = components.scheduler.config.get("prediction_type", "epsilon")
        if self.prediction_type not in ("epsilon", "v_prediction", "sample"):
            raise UserError(
                f"{components.folder / 'scheduler'}: prediction_type {self.prediction_type!r} is not known; take a "
                "model with epsilon or v_prediction"
            )

    def predict_noise(
        self, z_t: Tensor, timesteps: Tensor, texts: dict[str, Tensor], condition: Tensor | None
    ) -> dict[str, Tensor]:
        """Noise (N, 4, L, L), float32, of each pass that `texts` names, with at most `views_per_call` pictures at once.

        Args:
            z_t: noisy latents (N, 4, L, L); timesteps: (N,) int64.
            texts: embeddings (N, length, width) for any of the passes `text`, `image`, `plain` (see `sds`).
            condition: the base's latents (N, 4, L, L) for 8 input channels; the pass `plain` sees zeros in their place.
        """
        passes, unet = len(texts), self.components.unet
        inputs = z_t
        if condition is not None:
            seen = [torch.zeros_like(condition) if name == "plain" else condition for name in texts]
            inputs = torch.cat([z_t.repeat(passes, 1, 1, 1), torch.cat(seen)], dim=1)
        elif passes > 1:
            inputs = z_t.repeat(passes, 1, 1, 1)
        times, embeddings = timesteps.repeat(passes), torch.cat(list(texts.values()))
        outputs = [
            unet(part.to(unet.dtype), time, encoder_hidden_states=text.to(unet.dtype), return_dict=False)[0].float()
            for part, time, text in zip(
                *(whole.split(self.config.views_per_call) for whole in (inputs, times, embeddings)), strict=True
            )
        ]
        alpha_bar = self.alpha_bars[timesteps]
        return {
            name: sds.noise_from_prediction(output, z_t, alpha_bar, self.prediction_type)
            for name, output in zip(texts, torch.cat(outputs).chunk(passes), strict=True)
        }

    def coefficients(self, how: Distillation) -> dict[str, float]:
        """Passes of the network that the variant and the scales ask for, with their coefficients."""
        if how.variant == "csd":
            return {"text": 1.0, "image" if self.needs_base else "plain": -1.0}
        if self.needs_base:
            return sds.cfg_coefficients_with_image(how.guidance_scale, how.image_guidance_scale)
        return sds.cfg_coefficients(how.guidance_scale)

    @torch.no_grad()
    def latent_gradient(self, chunk: Chunk, how: Distillation) -> tuple[Tensor, Tensor]:
        """Gradient with respect to z, and the clean latents that the network sees in z_t."""
        alpha_bar = self.alpha_bars[chunk.timesteps]
        weights = sds.weight(how.weighting, alpha_bar)
        noise = chunk.noise if chunk.mask is None else chunk.noise * chunk.mask
        z_t = sds.add_noise(chunk.z, noise, alpha_bar)
        predictions = self.predict_noise(z_t, chunk.timesteps, chunk.texts, chunk.condition)
        if how.variant == "csd":
            preview = sds.clean_estimate(z_t, predictions["text"], alpha_bar)
            plain = predictions["image" if self.needs_base else "plain"]
            gradient = sds.csd_gradient(predictions["text"], plain, weights)
        else:
            noise_hat = sds.combine(predictions, self.coefficients(how))
            if how.variant == "reconstruction":
                preview = self._denoise(z_t, noise_hat, chunk, how)
                gradient = sds.reconstruction_gradient(chunk.z, preview, weights)
            else:
                preview = sds.clean_estimate(z_t, noise_hat, alpha_bar)
                gradient = sds.sds_gradient(noise_hat, noise, weights)
        return gradient if chunk.mask is None else gradient * chunk.mask, preview

    def _denoise(self, z_t: Tensor, noise_hat: Tensor, chunk: Chunk, how: Distillation) -> Tensor:
        """Clean latents after RECONSTRUCTION_STEPS DDIM steps, evenly spaced from t; the first prediction is given."""
        now = chunk.timesteps
        for remaining in range(RECONSTRUCTION_STEPS - 1, 0, -1):
            following = chunk.timesteps * remaining // RECONSTRUCTION_STEPS
            z_t = sds.ddim_step(z_t, noise_hat, self.alpha_bars[now], self.alpha_bars[following])
            now = following
            predictions = self.predict_noise(z_t, now, chunk.texts, chunk.condition)
            noise_hat = sds.combine(predictions, self.coefficients(how))
        return sds.clean_estimate(z_t, noise_hat, self.alpha_bars[now])
