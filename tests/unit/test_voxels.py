"""The voxel grid: lookup and rendering against closed forms and finite differences, its loss and surface by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from fd_mitsuba.baselines.voxels.edit_stage import loss_correlation
from fd_mitsuba.baselines.voxels.grid import VoxelGrid, along, interpolated, on_film, ray_weights, rays_of
from fd_mitsuba.baselines.voxels.rendering import grid_images, render_normals, render_values, view_weights
from fd_mitsuba.baselines.voxels.surface import SURFACE_ALPHA, grid_surface
from fd_mitsuba.scene.triangle_mesh import topology
from fd_mitsuba.scene.views import CameraBatch

FRONT = CameraBatch.around(np.array([0.0]), 0.0, 3.0, 40.0)
AROUND = CameraBatch.around(np.array([20.0, 140.0]), 30.0, 3.0, 45.0)


def random_grid(resolution: int = 7, seed: int = 0) -> VoxelGrid:
    generator = torch.Generator().manual_seed(seed)
    grid = VoxelGrid(resolution)
    with torch.no_grad():
        grid.density.copy_(torch.randn(grid.density.shape, generator=generator) - 1)
        grid.features.copy_(torch.randn(grid.features.shape, generator=generator))
    return grid


def test_lookup_equals_scipys_trilinear_interpolation() -> None:
    grid = random_grid()
    points = (torch.rand(200, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1) * grid.half_extent
    density, features = grid.lookup(points)
    place = ((points.numpy() / grid.half_extent + 1) / 2 * (grid.resolution - 1)).T[::-1]  # z, y, x
    for found, values in ((density, grid.density), *zip(features, grid.features, strict=True)):
        wanted = map_coordinates(values.detach().numpy(), place, order=1)
        assert np.allclose(found.detach().numpy(), wanted, atol=1e-5)
    corner = torch.tensor([[1.0, -1.0, 1.0]]) * grid.half_extent
    assert interpolated(grid.density[None], corner, grid.half_extent).item() == grid.density[-1, 0, -1].item()


def test_a_slab_of_constant_density_covers_as_beer_and_lambert_say() -> None:
    """Every ray through the full cube: coverage 1 - exp(-sigma length), whatever the number of pieces."""
    grid = VoxelGrid(5)
    with torch.no_grad():
        grid.density.fill_(-1.5)
        grid.features[2] = 5.0  # longer than 1: counts as a unit vector along z
    sigma = np.log1p(np.exp(-1.5)) / grid.spacing
    rays = rays_of(FRONT, 8, grid.half_extent)
    length = (rays.far - rays.near).numpy()
    assert length.max() > 2.1 and (length.reshape(8, 8)[3:5, 3:5] < 2.2).all()
    wanted = 1 - np.exp(-sigma * length).reshape(8, 8)
    for samples in (1, 7, 64):
        normal, mask = render_normals(grid, FRONT, 8, samples)
        assert np.allclose(mask[0, 0].detach().numpy(), wanted, atol=1e-5)
        assert np.allclose(normal[0, 2].detach().numpy(), wanted, atol=1e-5)
        assert normal[0, :2].abs().max() < 1e-5
    side = CameraBatch.around(np.array([90.0]), 0.0, 3.0, 40.0)
    normal, mask = render_normals(grid, side, 8, 16)
    assert torch.allclose(normal[0, 0], -mask[0, 0], atol=1e-5), "from +x, +z is to the left"


def test_weights_by_hand() -> None:
    weights = ray_weights(torch.tensor([[1.0, 2.0, 0.0]]), torch.tensor([0.5]))
    first, second = 1 - np.exp(-0.5), np.exp(-0.5) * (1 - np.exp(-1.0))
    assert np.allclose(weights.numpy(), [[first, second, 0.0]], atol=1e-7)


def test_rays_go_through_the_pixels_that_points_fall_on() -> None:
    rays = rays_of(AROUND, 6, 1.05)
    for view in range(2):
        some = slice(view * 36, (view + 1) * 36)
        points, _ = along(rays.chosen(some), 3)
        film = on_film(points[:, 1], AROUND, view, 6)
        column, row = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(6) + 0.5, indexing="xy")
        assert torch.allclose(film, torch.stack([column.flatten(), row.flatten()], dim=1), atol=1e-4)
        missed = (rays.far == rays.near)[some]
        inside = points[~missed].abs().amax(dim=(1, 2))
        assert (inside < 1.05 + 1e-4).all()


def test_gradients_equal_finite_differences() -> None:
    grid = random_grid().double()
    generator = torch.Generator().manual_seed(2)
    wanted = torch.randn(2, 4, 5, 5, generator=generator, dtype=torch.float64)

    def loss() -> torch.Tensor:
        images = torch.cat(render_normals(grid, AROUND, 5, 12), dim=1)
        return (images * wanted).sum()

    loss().backward()
    for parameter in (grid.density, grid.features):
        flat, gradient = parameter.data.view(-1), parameter.grad.reshape(-1)
        for place in gradient.abs().topk(6).indices.tolist():
            before = flat[place].item()
            values = []
            for move in (1e-4, -1e-4):
                flat[place] = before + move
                values.append(loss().item())
            flat[place] = before
            assert (values[0] - values[1]) / 2e-4 == pytest.approx(gradient[place].item(), rel=2e-3, abs=1e-6)


def test_values_are_rendered_as_what_the_weights_say() -> None:
    grid = random_grid()
    values = torch.rand(2, 7, 7, 7, generator=torch.Generator().manual_seed(3))
    images = render_values(grid, values, AROUND, 6, 20)
    points, pixel, weight = view_weights(grid, AROUND, 6, 20)
    found = torch.zeros(72, 2).index_add(0, pixel, (interpolated(values, points, grid.half_extent) * weight).t())
    assert torch.allclose(found.view(2, 6, 6, 2).permute(0, 3, 1, 2), images, atol=2e-3)
    ones = render_values(grid, torch.ones(1, 7, 7, 7), AROUND, 6, 20)
    assert torch.allclose(ones, render_normals(grid, AROUND, 6, 20)[1], atol=1e-5)


def test_correlation_by_hand() -> None:
    base = torch.randn(4, 4, 4, generator=torch.Generator().manual_seed(4))
    other = torch.randn(4, 4, 4, generator=torch.Generator().manual_seed(5))
    assert loss_correlation(3 * base + 7, base).item() == pytest.approx(0, abs=1e-6)
    assert loss_correlation(-base, base).item() == pytest.approx(2, abs=1e-6)
    wanted = 1 - np.corrcoef(base.flatten().numpy(), other.flatten().numpy())[0, 1]
    assert loss_correlation(other, base).item() == pytest.approx(wanted, rel=1e-5)


def test_the_surface_of_a_ball_is_closed_and_as_large_as_the_ball() -> None:
    grid = VoxelGrid(33)
    radius = grid.vertices().norm(dim=1).view(33, 33, 33)
    with torch.no_grad():
        grid.density.copy_(grid.raw_of_alpha(SURFACE_ALPHA) + 4 * (0.6 - radius))
    mesh = grid_surface(grid)
    assert mesh is not None and topology(mesh.vertices, mesh.faces).closed
    assert mesh.volume() == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.02)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.6).max() < 0.1 * grid.spacing
    # A piece as long as a voxel at that density covers a half.
    assert 1 - np.exp(-float(grid.sigma(torch.tensor(grid.raw_of_alpha(0.5)))) * grid.spacing) == pytest.approx(0.5)
    with torch.no_grad():
        grid.density.fill_(-8.0)
    assert grid_surface(grid) is None


def test_a_white_background_stays_white_behind_empty_space() -> None:
    """Empty space covers two per cent of a ray; its colour must count where its coverage does."""
    grid = VoxelGrid(64, kind="colour", background=1.0)
    with torch.no_grad():
        grid.features.fill_(12.0)
    rgb = grid_images(grid, FRONT, 8, 64).rgb
    assert torch.allclose(rgb, torch.ones_like(rgb), atol=1e-3)
