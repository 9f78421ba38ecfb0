"""Editing single views with the guidance model itself, where it knows shapes: the stand-in that needs no download.

The built-in prior sees the base beside the noisy image, as InstructPix2Pix does, so that sampling it is editing. Each
view is one image of the model's full size, not a part of a mosaic: nothing ties it to another view.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.baselines.image_editors.views import Beginning, EditedViews
from fd_mitsuba.baselines.interface import EditedImages, EditTask, mesh_images
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.ddim import FIRST, sample, timesteps
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for

VIEWS_AT_ONCE = 4


class PriorEdit(EditedViews):
    """Views edited by the guidance model.

    Args:
        task: whose guidance is a diffusion model that knows shapes.
        steps: of DDIM.
        guidance_scale, image_guidance_scale: see `sds.cfg_coefficients_with_image`.
        repaints: only what the focal regions cover may change.
        margin: cells around them that may change, too.
    """

    def __init__(
        self,
        task: EditTask,
        steps: int,
        guidance_scale: float,
        image_guidance_scale: float,
        repaints: bool = False,
        margin: int = 0,
    ) -> None:
        super().__init__(task, steps)
        guidance = task.guidance.inner
        if not isinstance(guidance, DiffusionGuidance) or not guidance.conventions.is_packed:
            raise UserError(
                f"guidance.model = {task.config.guidance.source}: does not paint shapes by itself; name an image "
                "editor by the method's setting model"
            )
        if not repaints and not guidance.has_image_pass:
            raise UserError(
                f"guidance.model = {task.config.guidance.source}: does not see the image that it is to edit; name an "
                "image editor by the method's setting model"
            )
        self._guidance, self._repaints, self._margin = guidance, repaints, margin
        self.side = guidance.latent_size
        scales = guidance_scale, image_guidance_scale
        with_image = guidance.has_image_pass
        self._coefficients = (
            sds.cfg_coefficients_with_image(*scales) if with_image else sds.cfg_coefficients(guidance_scale)
        )

    def unedited(self, cameras: CameraBatch) -> EditedImages:
        """The base's normals at the size of the latents."""
        return mesh_images(base_mesh(self.scene), cameras, self.side)

    @torch.no_grad()
    def edit(self, cameras: CameraBatch, begin: Beginning | None = None) -> EditedImages:
        """Sampled latents, which are normals and coverage."""
        guidance, base = self._guidance, self.unedited(cameras)
        side, count, draw = self.side, len(cameras), 0 if begin is None else begin.draw
        pictures = self._pictures(base)
        known = guidance.encode(pictures, "coarse")
        generator = torch.Generator().manual_seed(seed_for(self.task.config.seed, Purpose.GUIDANCE, draw))
        noise = torch.randn(count, 4, side, side, generator=generator)
        first = FIRST if begin is None else begin.level
        if begin is not None:
            level = timesteps(1, len(guidance.alpha_bars), first) * count
            start = guidance.encode(self._pictures(begin.images), "coarse")
            noise = sds.add_noise(start, noise.to(guidance.device), guidance.alpha_bars[level])
        texts = guidance.embeddings(single_view_prompts(guidance, cameras), self._coefficients)
        inside = self.region_mask(cameras, side, self._margin).to(guidance.device) if self._repaints else None
        rows = []
        for at in range(0, count, VIEWS_AT_ONCE):
            few = slice(at, at + VIEWS_AT_ONCE)
            condition = guidance.seen_base(pictures[few], "coarse") if guidance.has_image_pass else None
            held = None if inside is None else (inside[few], known[few])
            own = {name: text[few] for name, text in texts.items()}
            seed = seed_for(self.task.config.seed, Purpose.PIXELS, at)
            noise_in = partial(self._noise_in, own, Beside(condition))
            rows.append(sample(noise_in, guidance.alpha_bars, noise[few], self.steps, held, seed, first))
        latents = torch.cat(rows).float().cpu()
        mask = guidance.latents.coverage(latents).clamp(0, 1)
        return EditedImages("normals", torch.minimum(torch.maximum(latents[:, :3], -mask), mask), mask)

    def _noise_in(self, texts: dict[str, Tensor], beside: Beside, z: Tensor, now: Tensor) -> Tensor:
        return sds.combine(self._guidance.predict_noise(z, now, texts, beside), self._coefficients)

    def _pictures(self, images: EditedImages) -> Tensor:
        return torch.cat([images.values, images.mask, images.mask], dim=1).to(self._guidance.device)


def single_view_prompts(guidance: DiffusionGuidance, cameras: CameraBatch, text: str | None = None) -> list[str]:
    """The text of each view, as the guidance words it for the first view of a mosaic.

    Args:
        text: in place of the guidance's prompt.
    """
    every = guidance.view_grid**2
    azimuths, elevations = (np.repeat(angles, every) for angles in (cameras.azimuth_deg, cameras.elevation_deg))
    views = GuidanceViews(torch.zeros(len(azimuths), 5, 1, 1), None, azimuths, elevations)
    return guidance.prompts(views, text)
