"""Iterative dataset update: consistent edits of single views end up in the grid, and no edit leaves it as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.baselines.image_editors.views import Beginning
from fd_mitsuba.baselines.in2n import In2nSettings
from fd_mitsuba.baselines.interface import EditedImages, mesh_images
from fd_mitsuba.baselines.voxels.dataset_update import DatasetUpdateStage
from fd_mitsuba.baselines.voxels.fitting import ViewRays, VoxelFitSettings, fit_cameras, fit_psnr, fitted_grid
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.rendering import grid_images
from fd_mitsuba.config import RunConfig
from fd_mitsuba.runs.own_meshes import as_mesh, joined
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.viewing.turntable import Mesh

VIEWS = fit_cameras(8, (-20.0, 45.0))
SIZE, SAMPLES = 32, 24
FIT = VoxelFitSettings(resolution=20, samples=SAMPLES, fit_steps=80, fit_views=10, fit_size=SIZE, fit_rays=512)


def ball(radius: float, centre: tuple[float, float, float]) -> Mesh:
    sphere = trimesh.creation.icosphere(3, radius)
    return as_mesh(sphere.vertices + np.array(centre), sphere.faces)


BODY = ball(0.5, (0, -0.2, 0))
EDITED = joined([BODY, ball(0.25, (0, 0.5, 0))])


def shown(mesh: Mesh):  # noqa: ANN201
    return lambda cameras, size: mesh_images(mesh, cameras, size)


@pytest.fixture(scope="module")
def fitted(mi: object) -> VoxelGrid:
    return fitted_grid(FIT, shown(BODY), 0)[0]


def stage_of(grid: VoxelGrid, edit: object, images: EditedImages, updates: int) -> DatasetUpdateStage:
    config = RunConfig()
    return DatasetUpdateStage(
        config, edit, grid, images, VIEWS, SIZE, updates, 12, 512, SAMPLES, 0.05, (0.02, 0.98)
    )  # fmt: skip


def run(stage: DatasetUpdateStage) -> None:
    for step in range(stage.steps):
        stage.step(step)


def test_what_every_view_is_painted_with_ends_up_in_the_grid(fitted: VoxelGrid) -> None:
    asked: list[tuple[float, float]] = []

    def paint(camera: CameraBatch, begin: Beginning) -> EditedImages:
        asked.append((float(camera.azimuth_deg[0]), begin.level))
        assert begin.images.mask.shape == (1, 1, SIZE, SIZE)
        return mesh_images(EDITED, camera, SIZE)

    before = fitted.density.detach().clone()
    stage = stage_of(fitted, paint, mesh_images(BODY, VIEWS, SIZE), 2 * len(VIEWS))
    run(stage)
    rounds = [sorted(azimuth for azimuth, _ in asked[part]) for part in (slice(0, 8), slice(8, 16))]
    assert rounds[0] == rounds[1] == sorted(map(float, VIEWS.azimuth_deg)), "each view once, and then each again"
    assert min(level for _, level in asked) < 0.3 and max(level for _, level in asked) > 0.7
    made = stage.field.grid
    to_edited, to_body = (fit_psnr(made, shown(mesh), SAMPLES) for mesh in (EDITED, BODY))
    # As good an image of the edited object, from sides that no view of the set has, as the fit had of the unedited one.
    assert to_edited > to_body + 3 and to_edited > fit_psnr(fitted, shown(BODY), SAMPLES) - 2
    assert torch.equal(fitted.density, before), "the fitted grid itself is left alone"


def test_an_editor_that_changes_nothing_leaves_the_fit_as_it_is(fitted: VoxelGrid) -> None:
    stage = stage_of(fitted, lambda camera, begin: begin.images, mesh_images(BODY, VIEWS, SIZE), len(VIEWS))
    run(stage)
    after, before = (fit_psnr(grid, shown(BODY), SAMPLES) for grid in (stage.field.grid, fitted))
    assert after > before - 1
    solid = [(grid.density > 0).float().mean().item() for grid in (stage.field.grid, fitted)]
    assert solid[0] == pytest.approx(solid[1], rel=0.1)


def test_rays_of_one_view_are_replaced_and_no_others(mi: object) -> None:
    images, other = mesh_images(BODY, VIEWS, SIZE), mesh_images(EDITED, VIEWS, SIZE)
    rays, wanted = (ViewRays(found, VIEWS, 1.05) for found in (images, other))
    for view in range(len(VIEWS)):
        rays.replace(view, EditedImages("normals", other.values[view : view + 1], other.mask[view : view + 1]))
        assert torch.equal(rays.seen, wanted.seen) == (view == len(VIEWS) - 1)


def test_colours_are_shown_before_a_plain_background_and_fitted() -> None:
    grid = VoxelGrid(16, kind="colour", background=0.25)
    images = grid_images(grid, VIEWS, 16, 16)
    assert images.kind == "colour" and images.mask.max() < 0.01
    assert (images.values - 0.25).abs().max() < 0.01

    def red(cameras: CameraBatch, size: int) -> EditedImages:
        mask = mesh_images(BODY, cameras, size).mask
        return EditedImages("colour", torch.cat([mask + 0.25 * (1 - mask), *(2 * [0.25 * (1 - mask)])], dim=1), mask)

    found, psnr = fitted_grid(FIT, red, 0, "colour", 0.25)
    middle = grid_images(found, VIEWS, 16, 16).values[:, :, 9, 8]
    assert psnr > 18 and middle[:, 0].min() > 0.9 and middle[:, 1:].max() < 0.1


def test_noise_lies_between_rising_shares() -> None:
    with pytest.raises(ValueError, match="two rising numbers"):
        In2nSettings(noise_range=(0.5, 0.1))
