"""The methods `voxe_global` and `voxe`: Vox-E without and with its refinement (arXiv 2303.12048), on normals.

A ReLU-field voxel grid is fitted to images of the base, and a copy of it is guided as a whole. The refinement keeps of
that what belongs to the edit, by the attention of the model to its words and a graph cut.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

from pydantic import Field

from fd_mitsuba.baselines.edit_maps import MapSettings, edit_maps, map_source
from fd_mitsuba.baselines.interface import BASELINES, EditTask
from fd_mitsuba.baselines.voxels.edit_stage import VoxelEditStage
from fd_mitsuba.baselines.voxels.edited import EditedVoxels
from fd_mitsuba.baselines.voxels.fitting import VoxelFitSettings, base_shown, fit_cameras, fitted_grid
from fd_mitsuba.baselines.voxels.refinement import CutSettings, as_large, attention_grids, edit_voxels, merged
from fd_mitsuba.baselines.voxels.rendering import render_normals
from fd_mitsuba.config.bounds import Rate, Steps, Weight
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.seeds import Purpose, seed_for

MAP_SIZE = 64
"""Pixels a side of the images that attention grids are fitted to."""


class VoxeGlobalSettings(VoxelFitSettings):
    """Of `voxe_global`."""

    learning_rate: Rate = 0.06
    """Of the edit. The original has 0.03 for twenty times as many steps as the quick settings have."""
    lambda_correlation: Weight = 30.0
    """Weight of the volumetric correlation loss. The original's 200 goes with gradients of another size: beside the
    quick settings' normalised ones it hardly lets the density change."""


@BASELINES.register("voxe_global", VoxeGlobalSettings)
def voxe_global(settings: VoxeGlobalSettings, task: EditTask) -> EditedVoxels:
    """Vox-E-Global: a voxel grid fitted to the base and guided as a whole, with a volumetric correlation loss."""
    base, psnr = fitted_grid(settings, base_shown(task.scene), task.config.seed)
    stage = VoxelEditStage(task.own, base, settings.samples, settings.learning_rate, settings.lambda_correlation)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    edited = EditedVoxels(task.scene, stage.field, {"fit_psnr_db": psnr})
    edited.guidance_calls = stage.steps
    return edited


class VoxeSettings(VoxeGlobalSettings, MapSettings):
    """Of `voxe`."""

    attention_steps: Steps = 200
    """Steps of the fit of the attention grids."""
    lambda_tv: Weight = 0.01
    """Weight of their total variation; the original's."""
    cut_cost: Weight = 5.0
    """Cost of parting two equal neighbours; the original's."""
    cut_sigma: Annotated[float, Field(gt=0, le=100)] = 0.5
    """How fast that falls with the difference of their normals; the original has 0.1 for colours."""

    @property
    def needs(self) -> str:
        """As in `MapSettings`."""
        return "voxe needs a diffusion model that sees one whole image; take voxe_global instead"


@BASELINES.register("voxe", VoxeSettings)
def voxe(settings: VoxeSettings, task: EditTask) -> EditedVoxels:
    """Vox-E: as `voxe_global`, then only voxels that the attention to the edit's words marks stay edited."""
    source = map_source(task, settings)
    base, psnr = fitted_grid(settings, base_shown(task.scene), task.config.seed)
    stage = VoxelEditStage(task.own, base, settings.samples, settings.learning_rate, settings.lambda_correlation)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    cameras = fit_cameras(settings.attention_views)
    space = task.config.geometry.normal_space
    shown = partial(render_normals, stage.field, samples=settings.samples, space=space)
    maps = as_large(edit_maps(task, settings, source, shown, cameras), MAP_SIZE)
    values = attention_grids(stage.field, maps, cameras, settings.samples, settings.attention_steps, settings.lambda_tv)
    cut = CutSettings(settings.cut_cost, settings.cut_sigma, seed_for(task.config.seed, Purpose.SAMPLES))
    edit = edit_voxels(stage.field, values, cut)
    share = float(edit.sum()) / max(float((stage.field.density > 0).sum()), 1.0)
    edited = EditedVoxels(task.scene, merged(stage.field, base, edit), {"fit_psnr_db": psnr, "edited_share": share})
    edited.guidance_calls = stage.steps + source.calls(settings.attention_views)
    return edited
