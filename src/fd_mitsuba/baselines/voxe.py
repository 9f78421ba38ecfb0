"""The method `voxe_global`: Vox-E without its refinement (arXiv 2303.12048), on normals and coverage.

A ReLU-field voxel grid is fitted to images of the base, and a copy of it is guided as a whole.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from fd_mitsuba.baselines.interface import BASELINES, EditTask
from fd_mitsuba.baselines.voxels.edit_stage import VoxelEditStage
from fd_mitsuba.baselines.voxels.edited import EditedVoxels
from fd_mitsuba.baselines.voxels.fitting import BaseRays, fit_cameras, fit_grid, fit_psnr
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import Points, Rate, Samples, Steps, Views, Weight
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.seeds import Purpose, seed_for


class VoxeGlobalSettings(Section):
    """Of `voxe_global`."""

    resolution: Annotated[int, Field(ge=8, le=256)] = 64
    """Voxels a side; the original has 160."""
    samples: Samples = 64
    """Points along a ray; the original has 256."""
    fit_steps: Steps = 600
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
