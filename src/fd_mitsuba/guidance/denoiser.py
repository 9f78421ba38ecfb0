"""From noisy latents to the guidance gradient: a UNet's passes, put together by a variant. Knows no pictures."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import NOTHING, Beside, Chunk
from fd_mitsuba.guidance.layout import latent_side
from fd_mitsuba.guidance.loading import Components
from fd_mitsuba.guidance.multiview import is_multiview
from fd_mitsuba.guidance.query import Distillation, Query, passes_of
from fd_mitsuba.guidance.side_by_side import cores_for_samples, of_samples


class Denoiser:
    """The UNet with its noise schedule.

    A UNet with 8 input channels sees a condition's latents beside z_t, and may say only what must be added to them
    (`adds_to_base`); classifier-free guidance leaves the condition out of one pass (`has_image_pass`). One with 9 sees
    a mask of what to repaint and the masked picture's latents in every pass (`inpaints`), or is one of the former kind
    that is also told where the part may be (`sees_region`). All need the base's pictures (`needs_base`). One that is
    told cameras sees `views_together` consecutive pictures at once.
    """

    def __init__(self, components: Components, config: GuidanceConfig, device: str = "cpu") -> None:
        self.config = config
        self.components = components
        self.device = torch.device(device)
        channels = components.unet.config.in_channels
        self.sees_region = components.conventions.sees_region
        self.has_image_pass = channels == 8 or self.sees_region
        self.inpaints = channels == 9 and not self.sees_region
        self.needs_base = self.has_image_pass or self.inpaints
        self.takes_cameras = is_multiview(dict(components.unet.config))
        self.views_together = components.conventions.views_together or 1
        self.looks_at_picture = True
        if self.device.type == "cpu" and components.conventions.is_packed:
            components.unet.to(memory_format=torch.channels_last)  # a tenth faster, for small networks
        self.adds_to_base = components.conventions.predicts == "difference"
        self.latent_size = latent_side(components.unet.config)
        self.alpha_bars = sds.levels(components.scheduler.alphas_cumprod).to(self.device)
        self.prediction_type = components.scheduler.config.get("prediction_type", "epsilon")

    def predict_noise(
        self, z_t: Tensor, timesteps: Tensor, texts: dict[str, Tensor], beside: Beside = NOTHING
    ) -> dict[str, Tensor]:
        """Noise (N, 4, L, L), float32, of each pass that `texts` names, with at most `views_per_call` pictures at once.

        Args:
            z_t: noisy latents (N, 4, L, L); timesteps: (N,) int64.
            texts: embeddings (N, length, width) for any of the passes `text`, `image`, `plain` (see `sds`), `negative`.
            beside: what else it sees of these pictures.

        Raises:
            UserError: no cameras for a network that takes them.
        """
        condition, control, cameras = beside.condition, beside.control, beside.cameras
        if self.takes_cameras and cameras is None:
            raise UserError(
                f"{self.components.folder}: a multi-view model, which must be told its cameras; it serves a run's "
                "guidance only, so take a model that sees single views"
            )
        passes, unet = len(texts), self.components.unet
        inputs, seen = z_t, []
        if condition is not None and self.sees_region and condition.shape[1] == z_t.shape[1]:
            condition = torch.cat([torch.zeros_like(condition[:, :1]), condition], dim=1)  # it is not told
        if condition is not None:
            blind = "plain" if self.has_image_pass else None
            seen = [torch.zeros_like(condition) if name == blind else condition for name in texts]
            inputs = torch.cat([z_t.repeat(passes, 1, 1, 1), torch.cat(seen)], dim=1)
        elif passes > 1:
            inputs = z_t.repeat(passes, 1, 1, 1)
        columns = {
            "inputs": inputs.to(unet.dtype),
            "times": timesteps.repeat(passes),
            "texts": torch.cat(list(texts.values())).to(unet.dtype),
        }
        if control is not None:
            columns["z_t"] = z_t.repeat(passes, 1, 1, 1).to(unet.dtype)
            columns["control"] = control.repeat(passes, 1, 1, 1).to(unet.dtype)
        if cameras is not None:
            columns["cameras"] = cameras.repeat(passes, 1).to(unet.dtype)
        if self.components.image_prompt is not None:
            columns["picture"] = self._pictures(tuple(texts), len(z_t)).to(unet.dtype)
        cores = cores_for_samples(unet, self.device)

        def call(*rows: Tensor) -> Tensor:
            return self._unet(dict(zip(columns, rows, strict=True)))

        outputs = of_samples(call, tuple(columns.values()), self.config.views_per_call, cores, self.views_together)
        if self.adds_to_base:
            outputs = outputs + torch.cat(seen)[:, -z_t.shape[1] :]
        alpha_bar = self.alpha_bars[timesteps]
        return {
            name: sds.noise_from_prediction(output, z_t, alpha_bar, self.prediction_type)
            for name, output in zip(texts, outputs.chunk(passes), strict=True)
        }

    def _unet(self, rows: dict[str, Tensor]) -> Tensor:
        known: dict[str, Any] = {"encoder_hidden_states": rows["texts"], "return_dict": False}
        steered: dict[str, Any] = {}
        if "control" in rows:
            assert self.components.controlnet is not None
            down, middle = self.components.controlnet(
                rows["z_t"],
                rows["times"],
                controlnet_cond=rows["control"],
                conditioning_scale=self.config.controlnet_scale,
                **known,
            )
            steered = {"down_block_additional_residuals": down, "mid_block_additional_residual": middle}
        if "cameras" in rows:
            steered["class_labels"] = rows["cameras"]
        if "picture" in rows:
            steered["added_cond_kwargs"] = {"image_embeds": [rows["picture"]]}
        return self.components.unet(rows["inputs"], rows["times"], **known, **steered)[0].float()

    def _pictures(self, names: tuple[str, ...], count: int) -> Tensor:
        """(passes count, 1, width): what is said of the picture in the pass with the prompt, zeros in the others.

        Where the picture is not looked at, the adapter's layers are left out.
        """
        assert self.components.image_prompt is not None
        scale = self.config.image_prompt_scale if self.looks_at_picture else 0.0
        for processor in self.components.unet.attn_processors.values():
            if hasattr(processor, "scale"):
                processor.scale = [scale]
        said = self.components.image_prompt.to(self.device)[None].expand(count, 1, -1)
        return torch.cat([said if name == "text" else torch.zeros_like(said) for name in names])

    def passes(self, how: Distillation) -> tuple[str, ...]:
        """Names of the network's passes that the variant and the scales ask for."""
        return passes_of(how, self.has_image_pass)

    @torch.no_grad()
    def latent_gradient(self, chunk: Chunk, how: Distillation) -> tuple[Tensor, Tensor]:
        """Gradient with respect to z, and the clean latents that the network sees in z_t."""
        gradient, preview = how.variant.gradient(Query(self, chunk, how))
        gradient, preview = gradient.to(chunk.z.dtype), preview.to(chunk.z.dtype)
        return gradient if chunk.mask is None else gradient * chunk.mask, preview

    def teach(self, chunk: Chunk, how: Distillation, total: int) -> float:
        """Leave the gradients of the critic's loss with its matrices; returns the loss.

            1 / total sum over pictures of  mean over latents of  (mask (e_critic(z_t) - e))^2

        Args:
            chunk: with timesteps and noise of its own.
            how: with the critic.
            total: pictures of the step, those of other chunks and processes too.
        """
        assert how.critic is not None
        query = Query(self, chunk, how)
        z_t = query.noised(chunk.timesteps)
        with torch.enable_grad(), how.critic.acting():
            error = query.passes(z_t, chunk.timesteps, ("text",))["text"] - query.noise
            error = error if chunk.mask is None else chunk.mask * error
            loss = error.square().flatten(1).mean(dim=1).sum() / total
            loss.backward()
        return float(loss.detach())
