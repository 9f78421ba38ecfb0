"""The method `in2n`: Instruct-NeRF2NeRF (arXiv 2303.12789), with the voxel grid of Vox-E in place of a NeRF.

A voxel grid is fitted to images of the base; then an editor of single images replaces these images one after the other,
each edited from the grid's present render, while the grid is fitted on (`voxels.dataset_update`). Nothing says where
the edit is: the whole image is edited.
"""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import AfterValidator, Field

from fd_mitsuba.baselines.editors_2d import Pix2Pix2dSettings, pix2pix_editor
from fd_mitsuba.baselines.interface import BASELINES, EditedImages, EditTask
from fd_mitsuba.baselines.voxels.dataset_update import DatasetUpdateStage
from fd_mitsuba.baselines.voxels.edited import EditedVoxels
from fd_mitsuba.baselines.voxels.fitting import VoxelFitSettings, base_shown, fit_cameras, fitted_grid
from fd_mitsuba.config.bounds import GuidanceScale, ModelName, Range, Rate, Steps, Views
from fd_mitsuba.evaluation.judged_views import BACKGROUND
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.loop import run_stage


def _rising(value: Range) -> Range:
    if not 0.02 <= value[0] <= value[1] <= 0.98:
        raise ValueError("must be two rising numbers from 0.02 to 0.98")
    return value


class In2nSettings(VoxelFitSettings):
    """Of `in2n`."""

    model: ModelName = ""
    """An InstructPix2Pix pipeline by folder or hub id; none: the guidance model."""
    instruction: str = ""
    """What to do with each image, for a pipeline; none: "put ... on ...", from the scene's prompts."""
    guidance_scale: GuidanceScale | None = None
    """Of the text; none: 7.5 with a pipeline, `guidance.guidance_scale` with the guidance model."""
    image_guidance_scale: GuidanceScale | None = None
    """Of the image; none: 1.5 with a pipeline, `guidance.image_guidance_scale` with the guidance model."""
    sampling_steps: Annotated[int, Field(ge=1, le=1000)] = 10
    """Of one edit of an image; the original has 20. There are as many edits as the steps of the run pay for."""
    views: Views = 12
    """Images of the set that is edited. As few as this, because 400 steps of a run pay for 40 edits alone."""
    update_steps: Steps = 20
    """Steps of the fit after each edit; the original has 10."""
    learning_rate: Rate = 0.03
    """Of these."""
    noise_range: Annotated[Range, AfterValidator(_rising)] = (0.7, 0.98)
    """The noise upon a render that is to be edited lies between these shares of all timesteps. The original has 0.02 to
    0.98 and some thousand edits; with a few, half of which change next to nothing, no edit comes about."""


@BASELINES.register("in2n", In2nSettings)
def in2n(settings: In2nSettings, task: EditTask) -> EditedVoxels:
    """Instruct-NeRF2NeRF: images of the base are edited one by one while a voxel grid is fitted to all of them."""
    editor = pix2pix_editor(
        Pix2Pix2dSettings(
            model=settings.model,
            instruction=settings.instruction,
            steps=settings.sampling_steps,
            guidance_scale=settings.guidance_scale,
            image_guidance_scale=settings.image_guidance_scale,
        ),
        task,
    )

    def lit(cameras: CameraBatch, size: int) -> EditedImages:
        return editor.base_images(cameras, size)

    shown = lit if settings.model else base_shown(task.scene)
    background = float(to_srgb(torch.tensor(BACKGROUND))) if settings.model else 0.0
    kind = "colour" if settings.model else "normals"
    base, psnr = fitted_grid(settings, shown, task.config.seed, kind, background)
    cameras = fit_cameras(settings.views, task.config.cameras.elevation_deg)
    stage = DatasetUpdateStage(
        task.config,
        editor.edit,
        base,
        shown(cameras, min(settings.fit_size, editor.side)),
        cameras,
        editor.side,
        max(1, task.config.geometry.steps // settings.sampling_steps),
        settings.update_steps,
        settings.fit_rays,
        settings.samples,
        settings.learning_rate,
        settings.noise_range,
    )
    run_stage(stage, task.folder, True, task.quiet, task.say)
    edited = EditedVoxels(task.scene, stage.field.grid, {"fit_psnr_db": psnr}, lit if settings.model else None)
    edited.guidance_calls = stage.steps * settings.sampling_steps
    return edited
