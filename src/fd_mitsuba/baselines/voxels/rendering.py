"""Images of a voxel grid: expected normal or colour, and coverage, or any other value at the voxels."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.baselines.interface import EditedImages, to_camera_space
from fd_mitsuba.baselines.voxels.grid import Rays, VoxelGrid, along, interpolated, ray_weights, rays_of
from fd_mitsuba.conventions import NormalSpace
from fd_mitsuba.scene.views import CameraBatch

RAYS_AT_ONCE = 1 << 13
_LEAST_WEIGHT = {"normals": 1e-3, "colour": 1e-4}
"""Of a point of a ray whose normal or colour counts. Most points lie in empty space (`grid.EMPTY`), which takes 4e-4 of
a ray: it needs no normal, but without a colour a plain background would be darker behind it."""


@torch.no_grad()
def grid_images(grid: VoxelGrid, cameras: CameraBatch, size: int, samples: int) -> EditedImages:
    """Images of what the grid has, normals in camera space or colours, without random numbers."""
    if grid.kind == "normals":
        return EditedImages("normals", *render_normals(grid, cameras, size, samples))
    images = _rendered(grid, cameras, size, samples)
    return EditedImages("colour", images[:, :3], images[:, 3:])


def render_normals(
    grid: VoxelGrid,
    cameras: CameraBatch,
    size: int,
    samples: int,
    generator: torch.Generator | None = None,
    space: NormalSpace = "camera",
) -> tuple[Tensor, Tensor]:
    """Normals times coverage (B, 3, size, size), and coverage (B, 1, size, size); gradients flow to the grid.

    Args:
        samples: pieces of a ray.
        space: frame of the normals; `world` is the canonical frame.
        generator: moves rays within their pixels and points within their pieces; None: middles, nothing random.
    """
    images = _rendered(grid, cameras, size, samples, generator)
    normal = images[:, :3]
    return to_camera_space(normal, cameras) if space == "camera" else normal, images[:, 3:]


@torch.no_grad()
def render_values(grid: VoxelGrid, values: Tensor, cameras: CameraBatch, size: int, samples: int) -> Tensor:
    """Expected values (B, C, size, size) along the rays of a grid of values (C, R, R, R) at the voxels' vertices."""
    rays, rows = rays_of(cameras, size, grid.half_extent), []
    for begin in range(0, len(rays.near), RAYS_AT_ONCE):
        points, length = along(rays.chosen(slice(begin, begin + RAYS_AT_ONCE)), samples)
        flat = points.view(-1, 3)
        raw = interpolated(grid.density[None], flat, grid.half_extent).view(points.shape[:2])
        weights = ray_weights(grid.sigma(raw), length)
        found = interpolated(values, flat, grid.half_extent).view(len(values), *points.shape[:2])
        rows.append((found * weights).sum(dim=2).t())
    return _as_images(torch.cat(rows), len(cameras), size)


def view_weights(grid: VoxelGrid, cameras: CameraBatch, size: int, samples: int) -> tuple[Tensor, Tensor, Tensor]:
    """The points (P, 3) that an image's rays see, those of weight, with (P,) the pixel of each and (P,) its weight.

    What is fitted to images while the density stays fixed needs nothing else: an image is the sum over its points.
    """
    rays = rays_of(cameras, size, grid.half_extent)
    points, pixels, kept = [], [], []
    with torch.no_grad():
        for begin in range(0, len(rays.near), RAYS_AT_ONCE):
            some, length = along(rays.chosen(slice(begin, begin + RAYS_AT_ONCE)), samples)
            raw = interpolated(grid.density[None], some.view(-1, 3), grid.half_extent).view(some.shape[:2])
            weights = ray_weights(grid.sigma(raw), length)
            ray, piece = (weights > _LEAST_WEIGHT[grid.kind]).nonzero(as_tuple=True)
            points.append(some[ray, piece])
            pixels.append(ray + begin)
            kept.append(weights[ray, piece])
    return torch.cat(points), torch.cat(pixels), torch.cat(kept)


def traced(grid: VoxelGrid, rays: Rays, samples: int, jitter: Tensor | None = None) -> Tensor:
    """(N, 4) expected world-space normal times coverage, or expected colour, and coverage, along N rays; gradients
    flow to the grid.

    Args:
        jitter: as in `along`.
    """
    points, length = along(rays, samples, jitter)
    shape = points.shape[:2]
    raw = interpolated(grid.density[None], points.view(-1, 3), grid.half_extent).view(shape)
    weights = ray_weights(grid.sigma(raw), length)
    # Normals count only where a ray ends: at one point in ten.
    ray, place = (weights.detach() > _LEAST_WEIGHT[grid.kind]).nonzero(as_tuple=True)
    shown = grid.shown(interpolated(grid.features, points[ray, place], grid.half_extent))
    expected = shown.new_zeros(shape[0], 3).index_add(0, ray, (shown * weights[ray, place]).t())
    covered = weights.sum(dim=1, keepdim=True)
    if grid.background:
        expected = expected + grid.background * (1 - covered)
    return torch.cat([expected, covered], dim=1)


def _rendered(
    grid: VoxelGrid, cameras: CameraBatch, size: int, samples: int, generator: torch.Generator | None = None
) -> Tensor:
    """`traced` as images (B, 4, size, size)."""
    count = len(cameras) * size * size
    pixel = None if generator is None else torch.rand(count, 2, generator=generator)
    piece = None if generator is None else torch.rand(count, 1, generator=generator)
    rays, rows = rays_of(cameras, size, grid.half_extent, pixel), []
    for begin in range(0, count, RAYS_AT_ONCE):
        few = slice(begin, begin + RAYS_AT_ONCE)
        rows.append(traced(grid, rays.chosen(few), samples, None if piece is None else piece[few]))
    return _as_images(torch.cat(rows), len(cameras), size)


def _as_images(rows: Tensor, count: int, size: int) -> Tensor:
    return rows.view(count, size, size, -1).permute(0, 3, 1, 2)
