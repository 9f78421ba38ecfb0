from __future__ import annotations

import pytest
import torch

from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.hash_grid import HashGrid
from fd_mitsuba.fields.lattice_sites import LatticeSites


def make_grid(**changes) -> HashGrid:
    settings = dict(levels=6, features=2, base_resolution=4, finest_resolution=40, log2_table=12, seed=3)
    grid = HashGrid(**{**settings, **changes})
    with torch.no_grad():
        grid.table.copy_(0.05 * torch.randn(grid.table.shape, generator=torch.Generator().manual_seed(1)))
    return grid


def two_blobs(grid: TetGrid) -> torch.Tensor:
    """Vertices near two far-apart corners: a sparse bounding box."""
    corner = torch.full((3,), 0.6)
    near = [(grid.vertices - sign * corner).norm(dim=1) < 0.35 for sign in (-1, 1)]
    return (near[0] | near[1]).nonzero()[:, 0]


def test_resolutions_grow_geometrically_between_the_given_ends():
    grid = HashGrid(levels=10, base_resolution=8, finest_resolution=128)
    assert grid.resolutions[0] == 8 and grid.resolutions[-1] == 128
    assert all(1.2 < b / a < 1.6 for a, b in zip(grid.resolutions, grid.resolutions[1:], strict=False))


@pytest.mark.parametrize("level", range(6))
def test_a_dense_level_gives_every_vertex_its_own_row_and_all_rows_stay_in_range(level):
    grid = make_grid()
    vertex = torch.arange(grid.resolutions[level] + 1)
    keys = [grid.axis_key(level, axis, vertex) for axis in range(3)]
    rows = (keys[0][:, None, None] ^ keys[1][:, None] ^ keys[2]).view(-1)
    assert 0 <= int(rows.min()) and int(rows.max()) < grid.rows[level] <= 2**12
    if grid.is_dense(level):
        assert len(rows.unique()) == len(rows)
    else:
        assert len(rows) > grid.rows[level] / 4
        assert len(rows.unique()) > 0.6 * min(len(rows), grid.rows[level])


def test_features_are_the_rows_at_lattice_vertices_and_linear_between_them():
    grid = make_grid(levels=1, base_resolution=4, finest_resolution=4, half_extent=1.0)
    rows = torch.tensor([3 ^ (1 << 3) ^ (2 << 6), 2 ^ (1 << 3) ^ (2 << 6)])
    points = torch.tensor([[0.5, -0.5, 0.0], [0.0, -0.5, 0.0], [0.25, -0.5, 0.0]])
    at = grid(points)
    torch.testing.assert_close(at[:2], grid.table[:, rows].t())
    torch.testing.assert_close(at[2], at[:2].mean(dim=0))


def test_points_beyond_the_cube_count_as_its_border():
    grid = make_grid()
    inside, outside = torch.tensor([[1.05, 0.2, -1.05]]), torch.tensor([[1.4, 0.2, -3.0]])
    torch.testing.assert_close(grid(inside), grid(outside))


def test_the_seed_decides_the_start_and_leaves_the_global_state_alone():
    before = torch.random.get_rng_state()
    first, again, other = HashGrid(seed=1), HashGrid(seed=1), HashGrid(seed=2)
    assert torch.equal(first.table, again.table) and not torch.equal(first.table, other.table)
    assert torch.equal(before, torch.random.get_rng_state())


def every_column(sites: LatticeSites, grid: HashGrid) -> torch.Tensor:
    features = sites.features(grid.table)
    return features.columns(torch.arange(len(sites)))


@pytest.mark.parametrize("resolution", [10, 24, 40])
def test_sites_equal_the_plain_version(resolution):
    grid, lattice = make_grid(), TetGrid(resolution)
    sites = LatticeSites(grid, lattice.axis, two_blobs(lattice))
    plain = grid(lattice.positions(sites.index)).t()
    assert (every_column(sites, grid) - plain).abs().max() < 1e-6


@pytest.mark.parametrize("slab", [1, 50, 2**16])
def test_sites_equal_the_plain_version_in_double_and_with_split_boxes(monkeypatch, slab):
    monkeypatch.setattr("fd_mitsuba.fields.lattice_sites._SMALLEST_BOX", 64)
    monkeypatch.setattr("fd_mitsuba.fields.lattice_sites._SLAB", slab)
    grid, lattice = make_grid().double(), TetGrid(20)
    index = two_blobs(lattice)
    sites = LatticeSites(grid, lattice.axis, index)
    assert len(sites._boxes) == 2
    assert torch.equal(sites.index.sort().values, index)
    plain = grid(lattice.positions(sites.index, torch.float64)).t()
    assert (every_column(sites, grid) - plain).abs().max() < 1e-13

    chosen = torch.arange(0, len(sites), 3)
    weights = torch.randn(grid.width, len(chosen), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (sites.select(grid.table, sites.features(grid.table), chosen) * weights).sum().backward()
    fast, grid.table.grad = grid.table.grad, None
    (grid(lattice.positions(sites.index[chosen], torch.float64)).t() * weights).sum().backward()
    assert (fast - grid.table.grad).abs().max() < 1e-13


def test_gradients_of_the_plain_and_the_site_version_pass_gradcheck():
    grid = make_grid(levels=2, base_resolution=1, finest_resolution=4, log2_table=4).double()
    lattice = TetGrid(4)
    sites = LatticeSites(grid, lattice.axis, torch.arange(20, 70, 2))
    chosen = torch.tensor([0, 3, 4, 17])
    assert torch.autograd.gradcheck(lambda t: sites.select(t, sites.features(t), chosen), (grid.table,))
    points = torch.rand(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, _: grid(p), (points, grid.table))


def test_no_sites_give_no_features():
    grid, lattice = make_grid(), TetGrid(4)
    sites = LatticeSites(grid, lattice.axis, torch.empty(0, dtype=torch.int64))
    assert every_column(sites, grid).shape == (grid.width, 0)
