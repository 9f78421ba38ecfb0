"""Guidance by a Diffusers pipeline in Stable Diffusion's layout: the adapter between pictures, network and `sds`.

One call of `guide`: views -> (mosaics) -> latents z -> z_t -> the UNet's noise -> gradient with respect to z -> back
through the encoder to the pictures. Pictures are handled in chunks, each of which ends with its gradient with respect
to the pictures; so the memory follows `views_per_call` in both phases, and the result does not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.interface import GuidanceResult, GuidanceViews, NonFiniteGuidance, Phase
from fd_mitsuba.guidance.layout import latent_side
from fd_mitsuba.guidance.loading import Components, load_components
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.guidance.prompts import TextEmbeddings, unknown_words, view_prompt
from fd_mitsuba.threads import network_threads

RECONSTRUCTION_STEPS = 4
"""DDIM steps from z_t down to the clean latents, for the variant `reconstruction`."""


@dataclass(frozen=True)
class _Chunk:
    """What the network needs for some pictures: all (n, ...), on its device, without gradients."""

    z: Tensor
    noise: Tensor
    timesteps: Tensor
    texts: dict[str, Tensor]
    condition: Tensor | None


class DiffusionGuidance:
    """Score distillation with Stable Diffusion 1.x/2.x or an InstructPix2Pix model; see `interface.Guidance`.

    A UNet with 8 input channels sees the base's latents of the same view beside z_t and takes `image_guidance_scale` as
    second scale. In the coarse phase (normal times coverage, 2 mask - 1) stands for scaled latents; in the refined
    phase the normals, as colours on black, go through the VAE encoder (its mean: only t and the noise are random).
    """

    def __init__(self, components: Components, config: GuidanceConfig, device: str = "cpu") -> None:
        self.config = config
        self.components = components
        self.device = torch.device(device)
        self.conventions = components.conventions
        self.view_grid = components.conventions.view_grid
        self.normal_space = components.conventions.normal_space
        self.needs_base = components.unet.config.in_channels == 8
        self.latent_size = latent_side(components.unet.config)
        vae = components.vae.config
        self.vae_scale_factor = 2 ** (len(vae.get("encoder_block_out_channels") or vae.block_out_channels) - 1)
        self.scaling_factor = float(vae.get("scaling_factor") or 1.0)
        self.shift_factor = float(vae.get("shift_factor") or 0.0)
        self.alpha_bars = components.scheduler.alphas_cumprod.to(device=self.device, dtype=torch.float32)
        self.prediction_type = components.scheduler.config.get("prediction_type", "epsilon")
        if self.prediction_type not in ("epsilon", "v_prediction", "sample"):
            raise UserError(
                f"{components.folder / 'scheduler'}: prediction_type {self.prediction_type!r} is not known; take a "
                "model with epsilon or v_prediction"
            )
        self._embed = TextEmbeddings(components.tokenizer, components.text_encoder)
        self._prompt: str | None = None
        self._negative_prompt = ""

    @classmethod
    def load(cls, config: GuidanceConfig, device: str = "cpu") -> DiffusionGuidance:
        """The guidance of `config.model`. Raises UserError as `loading.load_components` does."""
        return cls(load_components(config, device), config, device)

    def picture_size(self, phase: Phase) -> int:
        """Side in pixels of one view: the latents' own in the coarse phase, the VAE's input in the refined one."""
        return self.latent_size * (self.vae_scale_factor if phase == "refined" else 1) // self.view_grid

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """Take the texts; returns the words that the model cannot know (none where it has CLIP's own vocabulary)."""
        self._prompt, self._negative_prompt = prompt, negative_prompt
        if not self.conventions.whole_words:
            return []
        return unknown_words(self.components.tokenizer, f"{prompt} {negative_prompt}")

    def prompts(self, views: GuidanceViews) -> list[str]:
        """The text of each picture or mosaic; a mosaic goes by its first view."""
        if self._prompt is None:
            raise ValueError("set_prompt must be called before guide")
        return [
            view_prompt(self._prompt, float(azimuth), views.closeup, self.conventions, self.config.view_prompts)
            for azimuth in list(views.azimuth_deg)[:: self.view_grid**2]
        ]

    @network_threads()
    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: Phase, seed: int) -> GuidanceResult:
        """The loss whose gradient is the mean over pictures (mosaics) of the guidance gradient summed over latents.

            d loss / d pictures = (1 / N) sum over latents of  g dz / d pictures,   g = w(t) (e_hat - e)  for `sds`

        (paper, the SDS equations of "Preliminary" and "Geometry Editing"). `seed` and `step` decide t and the noise.

        Raises:
            NonFiniteGuidance: a NaN or an infinity in the gradient.
            ValueError: pictures of the wrong size or number, no base for a model that needs it.
        """
        images, base = self._images(views, phase)
        count = len(images)
        timesteps, noise = self._draw(count, step, steps_total, phase, seed)
        coefficients = self._coefficients()
        texts = self._texts(self.prompts(views), coefficients)
        rows_per_chunk = max(1, self.config.views_per_call // len(coefficients))
        track = images.requires_grad and torch.is_grad_enabled()

        picture_gradients, latent_gradients, previews = [], [], []
        for start in range(0, count, rows_per_chunk):
            rows = slice(start, start + rows_per_chunk)
            leaf = images[rows].detach().requires_grad_(track)
            with torch.set_grad_enabled(track):
                z = self.encode(leaf, phase)
            chunk = _Chunk(
                z=z.detach(),
                noise=noise[rows],
                timesteps=timesteps[rows],
                texts={name: embedding[rows] for name, embedding in texts.items()},
                condition=None if base is None else self._condition(base[rows], phase),
            )
            gradient, preview = self._latent_gradient(chunk, coefficients)
            self._check_finite(gradient, chunk.timesteps, "latents")
            if track:
                picture_gradients.append(torch.autograd.grad(z, leaf, gradient)[0])
                self._check_finite(picture_gradients[-1], chunk.timesteps, "pictures")
            latent_gradients.append(gradient)
            previews.append(preview)

        gradient = torch.cat(latent_gradients)
        # The way back to the pictures is linear, so that it may be scaled at its end, when all chunks are known.
        scale = 1 / count
        if self.config.normalise_gradient:
            scale *= sds.normalising_scale(gradient)
        value = 0.5 * scale * float(gradient.square().sum())
        loss = images.new_tensor(value)
        if track:
            loss = sds.carry_gradient(images, scale * torch.cat(picture_gradients), value)
        logs = {
            "guidance_loss": value,
            "guidance_gradient_mean": float(gradient.abs().mean()),
            "guidance_gradient_max": float(gradient.abs().max()),
            "guidance_timestep": float(timesteps.float().mean()),
        }
        return GuidanceResult(loss=loss, logs=logs, preview=torch.cat(previews))

    def encode(self, images: Tensor, phase: Phase) -> Tensor:
        """Scaled latents z (N, 4, L, L) of geometry pictures or mosaics (N, 5, H, H). Gradients flow.

        coarse: (n coverage, 2 mask - 1) as it is; refined: scaling_factor (E(2 (n + mask) / 2 - 1) - shift_factor).
        """
        normal, mask = images[:, :3], images[:, 3:4]
        if phase == "coarse":
            return torch.cat([normal, 2 * mask - 1], dim=1).float()
        # (n + 1) / 2 on covered pixels over black is (n coverage + mask) / 2; the VAE takes twice that less 1.
        encoded = self.components.vae.encode((normal + mask - 1).float())
        latents = encoded.latents if hasattr(encoded, "latents") else encoded.latent_dist.mean
        return (latents - self.shift_factor) * self.scaling_factor

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

    @torch.no_grad()
    def _latent_gradient(self, chunk: _Chunk, coefficients: dict[str, float]) -> tuple[Tensor, Tensor]:
        """Gradient with respect to z, and the clean latents that the network sees in z_t."""
        alpha_bar = self.alpha_bars[chunk.timesteps]
        weights = sds.weight(self.config.weighting, alpha_bar)
        z_t = sds.add_noise(chunk.z, chunk.noise, alpha_bar)
        predictions = self.predict_noise(z_t, chunk.timesteps, chunk.texts, chunk.condition)
        if self.config.variant == "csd":
            preview = sds.clean_estimate(z_t, predictions["text"], alpha_bar)
            plain = predictions["image" if self.needs_base else "plain"]
            return sds.csd_gradient(predictions["text"], plain, weights), preview
        noise_hat = sds.combine(predictions, coefficients)
        if self.config.variant == "reconstruction":
            preview = self._denoise(z_t, noise_hat, chunk, coefficients)
            return sds.reconstruction_gradient(chunk.z, preview, weights), preview
        preview = sds.clean_estimate(z_t, noise_hat, alpha_bar)
        return sds.sds_gradient(noise_hat, chunk.noise, weights), preview

    def _denoise(self, z_t: Tensor, noise_hat: Tensor, chunk: _Chunk, coefficients: dict[str, float]) -> Tensor:
        """Clean latents after RECONSTRUCTION_STEPS DDIM steps, evenly spaced from t; the first prediction is given."""
        now = chunk.timesteps
        for remaining in range(RECONSTRUCTION_STEPS - 1, 0, -1):
            following = chunk.timesteps * remaining // RECONSTRUCTION_STEPS
            z_t = sds.ddim_step(z_t, noise_hat, self.alpha_bars[now], self.alpha_bars[following])
            now = following
            noise_hat = sds.combine(self.predict_noise(z_t, now, chunk.texts, chunk.condition), coefficients)
        return sds.clean_estimate(z_t, noise_hat, self.alpha_bars[now])

    def _coefficients(self) -> dict[str, float]:
        """Passes of the network that the variant and the scales ask for, with their coefficients."""
        if self.config.variant == "csd":
            return {"text": 1.0, "image" if self.needs_base else "plain": -1.0}
        if self.needs_base:
            return sds.cfg_coefficients_with_image(self.config.guidance_scale, self.config.image_guidance_scale)
        return sds.cfg_coefficients(self.config.guidance_scale)

    def _texts(self, prompts: list[str], passes: dict[str, float]) -> dict[str, Tensor]:
        negative = [self._negative_prompt] * len(prompts)
        return {name: self._embed(prompts if name == "text" else negative) for name in passes}

    def _images(self, views: GuidanceViews, phase: Phase) -> tuple[Tensor, Tensor | None]:
        size, wanted = views.pictures.shape[-1], self.picture_size(phase)
        if size != wanted:
            raise ValueError(f"the {phase} phase takes pictures of {wanted} x {wanted}, not {size} x {size}")
        if self.needs_base and views.base is None:
            raise ValueError("this model needs the base's pictures of the same views")
        if not views.pictures.isfinite().all():
            raise NonFiniteGuidance(
                f"the pictures rendered for the {phase} phase are not finite; the surface has broken"
            )
        images = tile_views(views.pictures, self.view_grid).to(self.device)
        if not self.needs_base:
            return images, None
        return images, tile_views(views.base, self.view_grid).to(self.device).detach()

    @torch.no_grad()
    def _condition(self, base: Tensor, phase: Phase) -> Tensor:
        """The base's latents as InstructPix2Pix takes them: as the encoder gives them, not scaled."""
        return self.encode(base, phase) / self.scaling_factor + self.shift_factor

    def _draw(self, count: int, step: int, steps_total: int, phase: Phase, seed: int) -> tuple[Tensor, Tensor]:
        """Timesteps (count,) and noise (count, 4, L, L); drawn on the CPU, so that the device does not change them."""
        key = np.random.SeedSequence((seed, step, ("coarse", "refined").index(phase)))
        generator = torch.Generator().manual_seed(int(key.generate_state(1, np.uint64)[0] >> 1))
        bounds = sds.annealed_range(
            self.config.timestep_range_refined if phase == "refined" else self.config.timestep_range_coarse,
            self.config.timestep_anneal,
            min(step / max(steps_total - 1, 1), 1.0),
        )
        timesteps = sds.draw_timesteps(bounds, len(self.alpha_bars), count, generator)
        noise = torch.randn((count, 4, self.latent_size, self.latent_size), generator=generator)
        return timesteps.to(self.device), noise.to(self.device)

    def _check_finite(self, gradient: Tensor, timesteps: Tensor, where: str) -> None:
        bad = ~gradient.isfinite().flatten(1).all(1)
        if bad.any():
            raise NonFiniteGuidance(
                f"{self.components.folder}: the guidance gradient of the {where} is not finite at timestep "
                f"{', '.join(str(int(t)) for t in timesteps[bad])}; set guidance.dtype to float32 or "
                "lower guidance.guidance_scale"
            )
