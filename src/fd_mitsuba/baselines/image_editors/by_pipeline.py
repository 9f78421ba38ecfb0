"""Editing single views with a Diffusers pipeline of images, from a folder or hub id: InstructPix2Pix, inpainting."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.baselines.image_editors.views import Beginning, EditedViews
from fd_mitsuba.baselines.interface import EditedImages, EditTask, mesh_images
from fd_mitsuba.errors import UserError, first_line
from fd_mitsuba.evaluation.judged_views import BACKGROUND, coloured
from fd_mitsuba.guidance.control import locate_controlnet
from fd_mitsuba.guidance.device import own_device, require_device
from fd_mitsuba.guidance.loading import locate, quiet_loading
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.part_shading import PartShading
from fd_mitsuba.render.tonemap import CLAY_LEVEL, auto_exposure, to_srgb
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for

LIT_SPP = 64
CHANGED = 0.08
"""A pixel this far from the plain background, in sRGB, is taken for the object's."""


class PipelineEdit(EditedViews):
    """Colour images of the base under the scene's light, edited one by one.

    Args:
        pipeline: a Diffusers pipeline, loaded.
        text: the instruction or the prompt.
        scales: further arguments of the pipeline's call, such as `guidance_scale`.
        repaints: the pipeline takes a mask of what to paint.
        sees_control: it takes a ControlNet's image of the same, in which what is to be painted is -1.
    """

    def __init__(
        self, task: EditTask, pipeline: Any, steps: int, text: str, scales: dict[str, float], repaints: bool,
        sees_control: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(task, steps)
        self._pipeline, self._text, self._scales = pipeline, text, scales
        self._repaints, self._sees_control = repaints, sees_control
        self._scheduler = pipeline.scheduler
        self.side = int(pipeline.unet.config.sample_size) * int(pipeline.vae_scale_factor)

    def unedited(self, cameras: CameraBatch) -> EditedImages:
        """The base as it is lit, on plain grey; shaded by a lamp at the camera where the scene has no light."""
        shape = mesh_images(base_mesh(self.scene), cameras, self.side)
        if not self.scene.has_light:
            return EditedImages("colour", coloured(torch.cat([shape.values, shape.mask], dim=1), "shaded"), shape.mask)
        return self._lit_base.images(cameras)

    def edit(self, cameras: CameraBatch, begin: Beginning | None = None) -> EditedImages:
        """What the pipeline makes of each view, with the same random numbers for each."""
        base = self.unedited(cameras)
        inside = self.region_mask(cameras, self.side, self.side // 64) if self._repaints else None
        seed = seed_for(self.task.config.seed, Purpose.GUIDANCE, 0 if begin is None else begin.draw)
        self._pipeline.scheduler = self._scheduler if begin is None else self._shorter_scheduler(begin.level)
        rows = []
        for index, picture in enumerate(base.values):
            more: dict[str, Any] = {"image": _as_image(picture), **self._scales}
            if inside is not None:
                more["mask_image"] = Image.fromarray((inside[index, 0].numpy() * 255).astype(np.uint8))
            if self._sees_control and inside is not None:
                more["control_image"] = torch.where(inside[index] > 0, -torch.ones(()), picture)[None]
            if begin is not None:
                more["latents"] = self._noised(begin.images.values[index : index + 1], seed)
            with network_threads():
                made = self._pipeline(
                    prompt=self._text,
                    num_inference_steps=self.steps,
                    generator=torch.Generator().manual_seed(seed),
                    output_type="np",
                    **more,
                ).images[0]
            rows.append(torch.from_numpy(np.asarray(made, np.float32)).permute(2, 0, 1))
        values = torch.stack(rows)
        if values.shape[-1] != self.side:
            values = interpolate(values, size=(self.side, self.side), mode="bilinear", antialias=True)
        return EditedImages("colour", values.clamp(0, 1), _object_mask(values))

    def _shorter_scheduler(self, level: float) -> Any:
        """DDIM over the timesteps up to a share of all, in as many steps."""
        import diffusers

        scheduler: Any = diffusers.DDIMScheduler.from_config(self._scheduler.config)
        most = round(level * scheduler.config.num_train_timesteps)
        scheduler.register_to_config(num_train_timesteps=max(most, self.steps))
        return scheduler

    @torch.no_grad()
    def _noised(self, picture: Tensor, seed: int) -> Tensor:
        """Latents of a picture (1, 3, S, S) with the noise of the present scheduler's first timestep."""
        pipeline = self._pipeline
        vae, scheduler = pipeline.vae, pipeline.scheduler
        found = vae.encode((2 * picture - 1).to(vae.device, vae.dtype))
        latents = found.latents if hasattr(found, "latents") else found.latent_dist.mean
        latents = latents * float(vae.config.scaling_factor)
        noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(seed)).to(latents)
        scheduler.set_timesteps(self.steps)
        return scheduler.add_noise(latents, noise, scheduler.timesteps[:1].to(latents.device))

    @cached_property
    def _lit_base(self) -> _LitBase:
        return _LitBase(self.task, self.side)


class _LitBase:
    """Lit images of the base with its own materials, on plain grey."""

    def __init__(self, task: EditTask, size: int) -> None:
        scene = task.scene
        shading = PartShading.of(part_material(scene, (), True))
        self._alone = AppearancePass(scene, {}, shading, size, LIT_SPP)
        clay = AppearancePass(scene, {}, shading, 64, 16, deferred_base=True)
        around = CameraBatch.around(np.arange(4) * 90.0 + 20.0, 20.0, 3.4, 45.0)
        seen = clay.trace(around, 0)
        self._exposure = auto_exposure(clay.render_clay(seen, 0), seen.alpha, CLAY_LEVEL)

    @torch.no_grad()
    def images(self, cameras: CameraBatch) -> EditedImages:
        rows, masks = [], []
        for index in range(len(cameras)):
            seen = self._alone.trace(cameras.some(slice(index, index + 1)), index)
            linear = self._alone.render_base(seen, index) * self._exposure + BACKGROUND * (1 - seen.alpha)
            rows.append(to_srgb(linear).clamp(0, 1))
            masks.append(seen.alpha)
        return EditedImages("colour", torch.cat(rows), torch.cat(masks))


def load_editor(task: EditTask, kind: str, model: str, controlnet: str = "") -> Any:
    """A Diffusers pipeline by its class' name, of a folder or hub id, on the settings' device.

    Raises:
        UserError: no such model, or one that is not of this kind.
    """
    import diffusers

    folder = locate(model, setting="the method's model")
    parts: dict[str, Any] = {"safety_checker": None, "feature_extractor": None, "requires_safety_checker": False}
    device = require_device(own_device(task.config.guidance.device))
    diffusers.utils.logging.disable_progress_bar()
    try:
        with quiet_loading():
            if controlnet:
                parts["controlnet"] = diffusers.ControlNetModel.from_pretrained(locate_controlnet(controlnet))
            pipeline = getattr(diffusers, kind).from_pretrained(folder, local_files_only=True, **parts)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{folder}: cannot be loaded as {kind} ({first_line(error)}); give another model") from None
    finally:
        diffusers.utils.logging.enable_progress_bar()
    channels = pipeline.unet.config.in_channels
    wanted = 8 if kind == "StableDiffusionInstructPix2PixPipeline" else 4 if controlnet else 9
    if channels != wanted:
        raise UserError(f"{folder}: its UNet has {channels} input channels, {kind} needs {wanted}; give another model")
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to(device)


def _as_image(picture: Tensor) -> Image.Image:
    return Image.fromarray((picture.permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8))


def _object_mask(values: Tensor) -> Tensor:
    """(N, 1, S, S) of zeros and ones: what is not the plain background."""
    plain = to_srgb(torch.tensor(BACKGROUND))
    return ((values - plain).abs().amax(dim=1, keepdim=True) > CHANGED).float()
