"""Fits a voxel grid to images of the base: what Vox-E starts from."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from fd_mitsuba.baselines.interface import EditedImages, mesh_images
from fd_mitsuba.baselines.voxels.grid import EMPTY, Rays, VoxelGrid, on_film, rays_of
from fd_mitsuba.baselines.voxels.rendering import render_normals, traced
from fd_mitsuba.evaluation.picture_difference import psnr
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.viewing.turntable import Mesh

FOV_DEG, RADIUS = 45.0, 3.0
_JUDGED_SIZE, _JUDGED_VIEWS = 128, 8
_SOLID = 0.0
"""Raw density of the visual hull: a piece of one voxel's length covers a half. What is denser hides the inside of a
mug, which no silhouette shows, from the fit."""


def fit_cameras(count: int, aim: np.ndarray) -> CameraBatch:
    """`count` cameras spread evenly over a sphere around `aim`: a Fibonacci spiral."""
    turn = np.arange(count) * 180.0 * (3.0 - 5.0**0.5)
    elevation = np.degrees(np.arcsin(1 - (2 * np.arange(count) + 1) / count))
    return CameraBatch.around(turn, elevation, RADIUS, FOV_DEG, np.tile(aim, (count, 1)))


class BaseRays:
    """Rays through all pixels of images of the base, with what they see.

    Args:
        mesh: the base, canonical frame.
        cameras, size: the images are `size` x `size` pixels.
        half_extent: of the cube that rays are cut to.

    Attributes:
        rays: N of them, those that meet the cube.
        seen: (N, 4) world-space normal times coverage, and coverage.
    """

    def __init__(self, mesh: Mesh, cameras: CameraBatch, size: int, half_extent: float) -> None:
        rays = rays_of(cameras, size, half_extent)
        images = mesh_images(mesh, cameras, size)
        normal = _to_world(images.values, cameras)
        seen = torch.cat([normal, images.mask], dim=1).permute(0, 2, 3, 1).reshape(-1, 4)
        within = rays.far > rays.near
        self.rays = Rays(*(values[within] for values in (rays.origin, rays.direction, rays.near, rays.far)))
        self.seen = seen[within]
        self._covered = (self.seen[:, 3] > 0).nonzero()[:, 0]
        self._cameras, self._mask = cameras, images.mask

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
        """(count,) random rays, at least half of which see the base."""
        near = self._covered[torch.randint(len(self._covered), (count // 2,), generator=generator)]
        return torch.cat([near, torch.randint(len(self.seen), (count - count // 2,), generator=generator)])


def fit_grid(
    grid: VoxelGrid, rays: BaseRays, steps: int, batch: int, samples: int, learning_rate: float, seed: int
) -> VoxelGrid:
    """Fit `grid` to images of the base by L1 on normal and coverage; returns it.

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
        chosen = rays.draw(batch, generator)
        made = traced(grid, rays.rays.chosen(chosen), samples, torch.rand(batch, 1, generator=generator))
        loss = (made - rays.seen[chosen]).abs().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return grid


@torch.no_grad()
def fit_psnr(grid: VoxelGrid, mesh: Mesh, aim: np.ndarray, samples: int) -> float:
    """PSNR in dB of the grid's normal images against the base's, 8 views at 128 pixels that no fit has seen."""
    turn = np.arange(_JUDGED_VIEWS) * (360.0 / _JUDGED_VIEWS) + 11.0
    cameras = CameraBatch.around(turn, 20.0, RADIUS, FOV_DEG, np.tile(aim, (len(turn), 1)))
    made = EditedImages("normals", *render_normals(grid, cameras, _JUDGED_SIZE, samples))
    wanted = mesh_images(mesh, cameras, _JUDGED_SIZE)
    found = psnr(made.rgb, wanted.rgb, torch.ones_like(wanted.mask, dtype=torch.bool))
    assert found is not None
    return found


def _to_world(normals: Tensor, cameras: CameraBatch) -> Tensor:
    """The inverse of `to_camera_space`."""
    axes = torch.from_numpy(np.stack(cameras.basis(), axis=1))
    return torch.einsum("nji,njhw->nihw", axes, normals)
