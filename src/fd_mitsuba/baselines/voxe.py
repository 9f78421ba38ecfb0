"""The methods `voxe_global` and `voxe`: Vox-E without and with its refinement (arXiv 2303.12048), on normals.

A ReLU-field voxel grid is fitted to images of the base, and a copy of it is guided as a whole. The refinement keeps of
that what belongs to the edit, by the attention of the model to its words and a graph cut.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from fd_mitsuba.baselines.edit_maps import (
    DRAWS,
    attention_maps,
    difference_maps,
    looked_at,
    refuse_without_attention,
)
from fd_mitsuba.baselines.interface import BASELINES, EditTask
from fd_mitsuba.baselines.voxels.attention import split_words
from fd_mitsuba.baselines.voxels.edit_stage import VoxelEditStage
from fd_mitsuba.baselines.voxels.edited import EditedVoxels
from fd_mitsuba.baselines.voxels.fitting import BaseRays, fit_cameras, fit_grid, fit_psnr
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.refinement import CutSettings, as_large, attention_grids, edit_voxels, merged
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import Points, Rate, Samples, Steps, Views, Weight
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.seeds import Purpose, seed_for

MAP_SIZE = 64
"""Pixels a side of the images that attention grids are fitted to."""


class VoxeGlobalSettings(Section):
    """Of `voxe_global`."""

    resolution: Annotated[int, Field(ge=8, le=256)] = 64
    """Voxels a side; the original has 160."""
    samples: Samples = 64
    """Points along a ray; the original has 256."""
    fit_steps: Steps = 800
    """Steps of the fit to images of the base."""
    fit_views: Views = 48
    """How many images these are."""
    fit_size: Annotated[int, Field(ge=16, le=512)] = 128
    """Pixels a side of them."""
    fit_rays: Points = 2048
    """Rays of a step of the fit."""
    fit_learning_rate: Rate = 0.1
    """Of the fit; falls to a tenth."""
    learning_rate: Rate = 0.06
    """Of the edit. The original has 0.03 for twenty times as many steps as the quick settings have."""
    lambda_correlation: Weight = 30.0
    """Weight of the volumetric correlation loss. The original's 200 goes with gradients of another size: beside the
    quick settings' normalised ones it hardly lets the density change."""


def fitted_grid(settings: VoxeGlobalSettings, scene: EditScene, seed: int) -> tuple[VoxelGrid, float]:
    """A voxel grid of the scene's base, and the PSNR in dB of its images; see `fitting.fit_psnr`."""
    mesh, grid = base_mesh(scene), VoxelGrid(settings.resolution)
    aim = np.zeros(3)
    rays = BaseRays(mesh, fit_cameras(settings.fit_views, aim), settings.fit_size, grid.half_extent)
    fit_grid(
        grid, rays, settings.fit_steps, settings.fit_rays, settings.samples, settings.fit_learning_rate,
        seed_for(seed, Purpose.FIELD),
    )  # fmt: skip
    return grid, fit_psnr(grid, mesh, aim, 2 * settings.samples)


@BASELINES.register("voxe_global", VoxeGlobalSettings)
def voxe_global(settings: VoxeGlobalSettings, task: EditTask) -> EditedVoxels:
    """Vox-E-Global: a voxel grid fitted to the base and guided as a whole, with a volumetric correlation loss."""
    base, psnr = fitted_grid(settings, task.scene, task.config.seed)
    stage = VoxelEditStage(task.own, base, settings.samples, settings.learning_rate, settings.lambda_correlation)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    edited = EditedVoxels(task.scene, stage.field, {"fit_psnr_db": psnr})
    edited.guidance_calls = stage.steps
    return edited


class VoxeSettings(VoxeGlobalSettings):
    """Of `voxe`."""

    maps: Literal["auto", "attention", "difference"] = "auto"
    """What says where the edit is: `attention` to its words, as in the original; `difference` of what the network sees
    with the prompt and with the base prompt; `auto`: the latter for priors of this package, whose attention is flat."""
    edit_word: str = ""
    """The prompt's word for what is new; none: the words that the base prompt has not."""
    attention_views: Views = 24
    """Views whose attention is recorded."""
    attention_time: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """The noise level at which it is, as a share of all timesteps; the original's."""
    attention_steps: Steps = 200
    """Steps of the fit of the attention grids."""
    lambda_tv: Weight = 0.01
    """Weight of their total variation; the original's."""
    cut_cost: Weight = 5.0
    """Cost of parting two equal neighbours; the original's."""
    cut_sigma: Annotated[float, Field(gt=0, le=100)] = 0.5
    """How fast that falls with the difference of their normals; the original has 0.1 for colours."""


@BASELINES.register("voxe", VoxeSettings)
def voxe(settings: VoxeSettings, task: EditTask) -> EditedVoxels:
    """Vox-E: as `voxe_global`, then only voxels that the attention to the edit's words marks stay edited."""
    by_words = looks_for_words(task, settings)
    words = split_words(task.scene.prompt, task.scene.base_prompt, settings.edit_word) if by_words else ([], [])
    base, psnr = fitted_grid(settings, task.scene, task.config.seed)
    stage = VoxelEditStage(task.own, base, settings.samples, settings.learning_rate, settings.lambda_correlation)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    cameras = fit_cameras(settings.attention_views, np.zeros(3))
    seen = looked_at(task, stage.field, cameras, settings.samples, settings.attention_time)
    if by_words:
        maps = attention_maps(task, seen, cameras, words)
        maps = maps / maps.amax(dim=(0, 2, 3), keepdim=True).clamp(min=1e-12)
    else:
        maps = difference_maps(task, seen, cameras)
    maps = as_large(maps, MAP_SIZE)
    values = attention_grids(stage.field, maps, cameras, settings.samples, settings.attention_steps, settings.lambda_tv)
    cut = CutSettings(settings.cut_cost, settings.cut_sigma, seed_for(task.config.seed, Purpose.SAMPLES))
    edit = edit_voxels(stage.field, values, cut)
    share = float(edit.sum()) / max(float((stage.field.density > 0).sum()), 1.0)
    edited = EditedVoxels(task.scene, merged(stage.field, base, edit), {"fit_psnr_db": psnr, "edited_share": share})
    edited.guidance_calls = stage.steps + settings.attention_views * (1 if by_words else DRAWS)
    return edited


def looks_for_words(task: EditTask, settings: VoxeSettings) -> bool:
    """Whether the maps are those of cross-attention; UserError where neither kind can be had."""
    guidance = refuse_without_attention(task)
    by_words = settings.maps == "attention" or (settings.maps == "auto" and not guidance.conventions.is_packed)
    if not by_words and not task.scene.base_prompt:
        raise UserError(f"{task.scene.path}: has no base_prompt, which voxe compares the prompt with; add one")
    return by_words
