"""Fits a voxel grid to images of an object: what Vox-E and Instruct-NeRF2NeRF start from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import max_pool2d

from fd_mitsuba.baselines.interface import EditedImages, ImageKind, mesh_images, to_world_space
from fd_mitsuba.baselines.voxels.grid import EMPTY, VoxelGrid, on_film, rays_of
from fd_mitsuba.baselines.voxels.rendering import grid_images, traced
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import Points, Rate, Samples, Steps, Views
from fd_mitsuba.evaluation.picture_difference import psnr
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for

FOV_DEG, RADIUS = 45.0, 3.0
_JUDGED_SIZE, _JUDGED_VIEWS = 128, 8
_SOLID = 0.0
"""Raw density of the visual hull: a piece of one voxel's length covers a half. What is denser hides the inside of a
mug, which no silhouette shows, from the fit."""

Shown = Callable[[CameraBatch, int], EditedImages]
"""What makes images of an object: any cameras, pixels a side."""


class VoxelFitSettings(Section):
    """Of the voxel grid and its fit to images of the base."""

    resolution: Annotated[int, Field(ge=8, le=256)] = 64
    """Voxels a side; Vox-E has 160."""
    samples: Samples = 64
    """Points along a ray; Vox-E has 256."""
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


def fit_cameras(count: int, elevation_deg: tuple[float, float] = (-90.0, 90.0)) -> CameraBatch:
    """`count` cameras spread evenly over a sphere around the origin, or over a band of it: a Fibonacci spiral."""
    turn = np.arange(count) * 180.0 * (3.0 - 5.0**0.5)
    low, high = np.sin(np.radians(elevation_deg))
    elevation = np.degrees(np.arcsin(high - (high - low) * (2 * np.arange(count) + 1) / (2 * count)))
    return CameraBatch.around(turn, elevation, RADIUS, FOV_DEG)


class ViewRays:
    """Rays through all pixels of images of an object, with what they see.

    Args:
        images: N views, their pixels a ray each.
        cameras: of the images.
        half_extent: of the cube that rays are cut to.

    Attributes:
        rays: those that meet the cube, view after view.
        seen: (R, 4) for each of them world-space normal times coverage, or colour, and coverage.
    """

    def __init__(self, images: EditedImages, cameras: CameraBatch, half_extent: float) -> None:
        size = images.mask.shape[-1]
        rays = rays_of(cameras, size, half_extent)
        self._within = rays.far > rays.near
        self.rays = rays.chosen(self._within)
        self.seen = _rows(images, cameras)[self._within]
        self._first = [0, *self._within.view(len(cameras), -1).sum(dim=1).cumsum(dim=0).tolist()]
        self._covered = (self.seen[:, 3] > 0).nonzero()[:, 0]
        self._cameras, self._mask = cameras, images.mask

    def replace(self, view: int, image: EditedImages) -> None:
        """Let the rays of one view see another image (of one view)."""
        within = self._within.view(len(self._cameras), -1)[view]
        rows = _rows(image, self._cameras.some(slice(view, view + 1)))
        self.seen[self._first[view] : self._first[view + 1]] = rows[within]
        self._covered = (self.seen[:, 3] > 0).nonzero()[:, 0]

    def hull(self, grid: VoxelGrid) -> Tensor:
        """(R, R, R) bool: vertices of a grid that every image has within its mask, or out of its sight."""
        points, size = grid.vertices(), self._mask.shape[-1]
        within = torch.ones(len(points), dtype=torch.bool)
        for view in range(len(self._cameras)):
            film = on_film(points, self._cameras, view, size)
            # A mask that is a pixel wider: what is thinner than a voxel would vanish between its vertices.
            wide = max_pool2d(self._mask[view], 3, stride=1, padding=1)[0] > 0
            cell = film.floor().long()
            seen = ((cell >= 0) & (cell < size)).all(dim=1)
            cell = cell.clamp(0, size - 1)
            within &= wide[cell[:, 1], cell[:, 0]] | ~seen
        return within.view((grid.resolution,) * 3)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """(count,) random rays, at least half of which see the object."""
        near = self._covered[torch.randint(len(self._covered), (count // 2,), generator=generator)]
        return torch.cat([near, torch.randint(len(self.seen), (count - count // 2,), generator=generator)])

    def loss(self, grid: VoxelGrid, count: int, samples: int, generator: torch.Generator) -> Tensor:
        """L1 between what `count` random rays see and what the grid shows them; gradients flow to the grid.

        Args:
            samples: pieces of a ray.
        """
        chosen = self.draw(count, generator)
        made = traced(grid, self.rays.chosen(chosen), samples, torch.rand(count, 1, generator=generator))
        return (made - self.seen[chosen]).abs().mean()


def fit_grid(
    grid: VoxelGrid, rays: ViewRays, steps: int, batch: int, samples: int, learning_rate: float, seed: int
) -> VoxelGrid:
    """Fit `grid` to images by L1 on normal or colour and coverage; returns it.

    It starts as the visual hull of the images' masks, which saves the steps that would carve it out of fog.

    Args:
        steps: of Adam, with a step size that falls to a tenth.
        batch: rays a step. samples: pieces of a ray.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        grid.density.fill_(EMPTY)
        grid.density[rays.hull(grid)] = _SOLID
    optimiser = torch.optim.Adam(grid.parameters(), lr=learning_rate, eps=1e-15)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = learning_rate * 0.1 ** (step / max(steps, 1))
        loss = rays.loss(grid, batch, samples, generator)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return grid


def fitted_grid(
    settings: VoxelFitSettings, shown: Shown, seed: int, kind: ImageKind = "normals", background: float = 0.0
) -> tuple[VoxelGrid, float]:
    """A voxel grid of what `shown` makes images of, and the PSNR in dB of its images; see `fit_psnr`.

    Args:
        kind, background: of the images; see `VoxelGrid`.
    """
    grid = VoxelGrid(settings.resolution, kind=kind, background=background)
    cameras = fit_cameras(settings.fit_views)
    rays = ViewRays(shown(cameras, settings.fit_size), cameras, grid.half_extent)
    fit_grid(
        grid, rays, settings.fit_steps, settings.fit_rays, settings.samples, settings.fit_learning_rate,
        seed_for(seed, Purpose.FIELD),
    )  # fmt: skip
    return grid, fit_psnr(grid, shown, 2 * settings.samples)


def base_shown(scene: EditScene) -> Shown:
    """Normals of a scene's base."""
    mesh = base_mesh(scene)
    return lambda cameras, size: mesh_images(mesh, cameras, size)


@torch.no_grad()
def fit_psnr(grid: VoxelGrid, shown: Shown, samples: int) -> float:
    """PSNR in dB of the grid's images against those of `shown`, 8 views at 128 pixels that no fit has seen."""
    turn = np.arange(_JUDGED_VIEWS) * (360.0 / _JUDGED_VIEWS) + 11.0
    cameras = CameraBatch.around(turn, 20.0, RADIUS, FOV_DEG)
    made, wanted = grid_images(grid, cameras, _JUDGED_SIZE, samples), shown(cameras, _JUDGED_SIZE)
    found = psnr(made.rgb, wanted.rgb, torch.ones_like(wanted.mask, dtype=torch.bool))
    assert found is not None
    return found


def _rows(images: EditedImages, cameras: CameraBatch) -> Tensor:
    """(N S S, 4) of N images, view after view, row after row."""
    values = to_world_space(images.values, cameras) if images.kind == "normals" else images.values
    return torch.cat([values, images.mask], dim=1).permute(0, 2, 3, 1).reshape(-1, 4)
