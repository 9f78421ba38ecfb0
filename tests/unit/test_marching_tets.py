from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from fd_mitsuba.extraction.marching_tets import (
    away_from_crossings,
    crossing_faces,
    crossing_faces_plain,
    crossing_fraction,
    edge_ends,
    true_positions,
)
from fd_mitsuba.extraction.tet_grid import TetGrid


def sphere(p: torch.Tensor) -> torch.Tensor:
    return 0.7 - (p - torch.tensor([0.011, -0.017, 0.023], dtype=p.dtype)).norm(dim=1)


def torus(p: torch.Tensor) -> torch.Tensor:
    ring = torch.stack([p[:, [0, 2]].norm(dim=1) - 0.6, p[:, 1]], dim=1)
    return 0.25 - ring.norm(dim=1)


def two_spheres(p: torch.Tensor) -> torch.Tensor:
    return torch.maximum(0.3 - (p - 0.4).norm(dim=1), 0.2 - (p + 0.5).norm(dim=1))


def extract(grid: TetGrid, sdf: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    edges, faces = crossing_faces((sdf > 0).view((grid.side,) * 3))
    ends = torch.stack(edge_ends(edges, (grid.side,) * 3))
    inner = torch.where(sdf[ends[0]] > 0, ends[0], ends[1])
    outer = ends.sum(dim=0) - inner
    positions = grid.positions(torch.arange(grid.count), sdf.dtype)
    fraction = crossing_fraction(sdf[inner], sdf[outer], grid.spacing)
    return positions[inner] + fraction[:, None] * (positions[outer] - positions[inner]), faces


def triangles(ends: torch.Tensor, faces: torch.Tensor) -> set[tuple]:
    """Triangles as cyclic triples of edges, so that order and winding count but the starting corner does not."""
    result = set()
    for face in ends[faces].tolist():
        corners = [tuple(corner) for corner in face]
        start = corners.index(min(corners))
        result.add((*corners[start:], *corners[:start]))
    return result


@pytest.mark.parametrize("shape, euler", [(sphere, 2), (torus, 0), (two_spheres, 4)])
def test_surfaces_are_closed_welded_manifolds_wound_outwards(shape, euler):
    grid = TetGrid(24)
    vertices, faces = extract(grid, shape(grid.vertices))
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == euler
    assert mesh.volume > 0
    assert len(np.unique(faces.numpy())) == len(vertices) == len(np.unique(vertices.numpy(), axis=0))
    assert mesh.area_faces.min() > 0


@pytest.mark.parametrize("shape", [sphere, torus])
def test_it_agrees_with_marching_cubes(shape):
    grid = TetGrid(32)
    sdf = shape(grid.vertices)
    vertices, faces = extract(grid, sdf)
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    volume = sdf.view((grid.side,) * 3).numpy()
    corners, cubes_faces, _, _ = marching_cubes(volume, 0.0, spacing=(grid.spacing,) * 3)
    cubes = trimesh.Trimesh(corners[:, ::-1] - grid.half_extent, cubes_faces[:, ::-1], process=False)
    assert mesh.area == pytest.approx(cubes.area, rel=0.01)
    assert mesh.volume == pytest.approx(abs(cubes.volume), rel=0.01)
    for one, other in ((mesh, cubes), (cubes, mesh)):
        distance, _ = cKDTree(trimesh.sample.sample_surface(other, 40000, seed=0)[0]).query(one.vertices)
        assert distance.max() < 0.5 * grid.spacing
    assert shape(vertices).abs().max() < 0.1 * grid.spacing


def test_the_fast_topology_equals_the_plain_one_on_noise():
    grid = TetGrid(9)
    for seed in range(5):
        inside = torch.rand(grid.count, generator=torch.Generator().manual_seed(seed)) < 0.2 + 0.15 * seed
        edges, faces = crossing_faces(inside.view((grid.side,) * 3))
        ends, plain_faces = crossing_faces_plain(inside, grid.tets())
        assert torch.equal(torch.stack(edge_ends(edges, (grid.side,) * 3), dim=1), ends)
        assert len(faces) == len(plain_faces)
        assert triangles(ends, faces) == triangles(ends, plain_faces)


def test_all_256_cells_equal_the_plain_ones():
    grid = TetGrid(2)
    corner = torch.tensor([0, 1, 3, 4, 9, 10, 12, 13])
    cells = torch.zeros(2, 2, 2, dtype=torch.bool)
    cells[0, 0, 0] = True
    tets = grid.tets()[:6]
    for case in range(256):
        inside = torch.zeros(grid.count, dtype=torch.bool)
        inside[corner] = torch.tensor([bool(case >> bit & 1) for bit in range(8)])
        edges, faces = crossing_faces(inside.view(3, 3, 3), cells)
        ends, plain_faces = crossing_faces_plain(inside, tets)
        assert triangles(torch.stack(edge_ends(edges, (3, 3, 3)), dim=1), faces) == triangles(ends, plain_faces)


def test_lattices_need_not_be_cubes():
    inside = torch.zeros(5, 4, 6, dtype=torch.bool)
    inside[2, 1:3, 1:5] = True
    edges, faces = crossing_faces(inside)
    lower, upper = edge_ends(edges, (5, 4, 6))
    where = torch.stack([torch.stack([v % 6, v // 6 % 4, v // 24], dim=1) for v in (lower, upper)]).float().mean(dim=0)
    mesh = trimesh.Trimesh(where.numpy(), faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.volume > 0


@pytest.mark.parametrize("filled", [False, True])
def test_no_crossing_gives_empty_tensors_of_the_right_shape(filled):
    inside = torch.full((4, 4, 4), filled)
    edges, faces = crossing_faces(inside)
    ends, plain_faces = crossing_faces_plain(inside.view(-1), TetGrid(3).tets())
    assert edges.shape == (0,) and faces.shape == plain_faces.shape == (0, 3) and ends.shape == (0, 2)


def test_exact_zeros_count_as_outside_and_give_no_degenerate_faces():
    grid = TetGrid(8, half_extent=1.0)
    sdf = 0.5 - grid.vertices.abs().amax(dim=1)  # a box whose sides lie exactly on lattice planes
    vertices, faces = extract(grid, sdf)
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.euler_number == 2 and mesh.area_faces.min() > 0
    assert np.abs(mesh.bounds) == pytest.approx(np.full((2, 3), 0.5), abs=1e-3)


def test_positions_pass_gradcheck():
    grid = TetGrid(5)
    sdf = sphere(grid.positions(torch.arange(grid.count), torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda values: extract(grid, values)[0], (sdf,))


def test_growing_the_values_moves_the_surface_outwards():
    grid = TetGrid(24)
    sdf = sphere(grid.vertices).requires_grad_()
    vertices, _ = extract(grid, sdf)
    direction = vertices.detach() - torch.tensor([0.011, -0.017, 0.023])
    ((vertices * torch.nn.functional.normalize(direction, dim=1)).sum(dim=1).mean()).backward()
    assert sdf.grad.sum() == pytest.approx(1.0, abs=0.05)  # d radius / d sdf of a distance field


def test_gradients_of_a_flat_field_are_bounded():
    inside = torch.tensor([1e-9, 1e-4, 1e-30], requires_grad=True)
    outside = torch.tensor([-1e-9, 0.0, 0.0], requires_grad=True)
    fraction = crossing_fraction(inside, outside, spacing=0.03)
    fraction.sum().backward()
    limit = 1 / (0.02 * 0.03) * 1.001
    assert torch.isfinite(fraction).all() and ((fraction > 0) & (fraction < 1)).all()
    assert inside.grad.abs().max() <= limit and outside.grad.abs().max() <= limit


def test_the_fraction_by_hand():
    """Linear, squeezed by a thousandth at both ends; a difference below 0.02 spacing is widened to that, evenly."""
    inside, outside = torch.tensor([0.3, 1e-4, 0.0015]), torch.tensor([-0.1, -2e-4, -0.0005])
    expected = torch.tensor([0.75, (1e-4 + 0.5 * 1.7e-3) / 2e-3, 0.75])
    torch.testing.assert_close(crossing_fraction(inside, outside, 0.1), 0.001 + 0.998 * expected)


def test_faces_do_not_depend_on_what_the_lookup_held():
    grid = TetGrid(6)
    inside = (torch.rand(grid.count, generator=torch.Generator().manual_seed(3)) < 0.5).view((grid.side,) * 3)
    lookup = torch.full((8 * grid.count,), 12345, dtype=torch.int32)
    for one, other in zip(crossing_faces(inside), crossing_faces(inside, lookup=lookup), strict=True):
        assert torch.equal(one, other)
    assert lookup[crossing_faces(inside)[0]].tolist() == list(range(len(crossing_faces(inside)[0])))


def test_positions_and_types_of_what_comes_back():
    marks = torch.tensor([[False, True, True], [True, False, False]])
    assert true_positions(marks).equal(torch.tensor([1, 2, 3]))
    edges, faces = crossing_faces(torch.arange(27).view(3, 3, 3) == 13)
    assert edges.dtype == faces.dtype == torch.int64 and edges.equal(edges.sort().values)
    # Kuhn's cut of eight cubes: 14 edges at the vertex that they share, and 24 of their tetrahedra.
    assert len(edges) == 14 and faces.shape == (24, 3)


def test_what_lies_away_from_crossings_one_vertex_after_another():
    values = torch.rand(5, 4, 6, generator=torch.Generator().manual_seed(1)) - 0.12
    values[0, 0, 0] = 0.0  # counts as outside
    away = away_from_crossings(values)
    for place in np.ndindex(*values.shape):
        around = values[tuple(slice(max(index - 1, 0), index + 2) for index in place)] > 0
        assert away[place] == (around.all() or not around.any())
    assert away.any() and not away.all()
