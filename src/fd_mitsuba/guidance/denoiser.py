"""From noisy latents to the guidance gradient: a UNet's passes, put together by a variant. Knows no pictures."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.layout import latent_side
from fd_mitsuba.guidance.loading import Components
from fd_mitsuba.guidance.model_conventions import FILE_NAME
from fd_mitsuba.guidance.side_by_side import cores_for_samples, of_samples
from fd_mitsuba.guidance.variants import Chunk, Distillation, Query, passes_of


class Denoiser:
    """The UNet with its noise schedule.

    A UNet with 8 input channels sees a condition's latents beside z_t (`needs_base`), and may say only what must be
    added to them (`adds_to_base`).
    """

    def __init__(self, components: Components, config: GuidanceConfig, device: str = "cpu") -> None:
        self.config = config
        self.components = components
        self.device = torch.device(device)
        self.needs_base = components.unet.config.in_channels == 8
        self.adds_to_base = components.conventions.predicts == "difference"
        self.latent_size = latent_side(components.unet.config)
        self.alpha_bars = components.scheduler.alphas_cumprod.to(device=self.device, dtype=torch.float32)
        self.prediction_type = components.scheduler.config.get("prediction_type", "epsilon")
        if self.prediction_type not in ("epsilon", "v_prediction", "sample"):
            raise UserError(
                f"{components.folder / 'scheduler'}: prediction_type {self.prediction_type!r} is not known; take a "
                "model with epsilon or v_prediction"
            )
        if self.adds_to_base and not (self.needs_base and self.prediction_type == "sample"):
            raise UserError(
                f"{components.folder / FILE_NAME}: predicts difference takes a UNet with 8 input channels and "
                "prediction_type sample; remove the entry"
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
        inputs, seen = z_t, []
        if condition is not None:
            seen = [torch.zeros_like(condition) if name == "plain" else condition for name in texts]
            inputs = torch.cat([z_t.repeat(passes, 1, 1, 1), torch.cat(seen)], dim=1)
        elif passes > 1:
            inputs = z_t.repeat(passes, 1, 1, 1)
        columns = inputs.to(unet.dtype), timesteps.repeat(passes), torch.cat(list(texts.values())).to(unet.dtype)
        cores = cores_for_samples(unet, self.device)
        outputs = of_samples(self._unet, columns, self.config.views_per_call, cores)
        if self.adds_to_base:
            outputs = outputs + torch.cat(seen)
        alpha_bar = self.alpha_bars[timesteps]
        return {
            name: sds.noise_from_prediction(output, z_t, alpha_bar, self.prediction_type)
            for name, output in zip(texts, outputs.chunk(passes), strict=True)
        }

    def _unet(self, inputs: Tensor, times: Tensor, texts: Tensor) -> Tensor:
        return self.components.unet(inputs, times, encoder_hidden_states=texts, return_dict=False)[0].float()

    def passes(self, how: Distillation) -> tuple[str, ...]:
        """Names of the network's passes that the variant and the scales ask for."""
        return passes_of(how, self.needs_base)

    @torch.no_grad()
    def latent_gradient(self, chunk: Chunk, how: Distillation) -> tuple[Tensor, Tensor]:
        """Gradient with respect to z, and the clean latents that the network sees in z_t."""
        gradient, preview = how.variant.gradient(Query(self, chunk, how))
        return gradient if chunk.mask is None else gradient * chunk.mask, preview
