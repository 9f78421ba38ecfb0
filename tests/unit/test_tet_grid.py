from __future__ import annotations

import pytest
import torch

from fd_mitsuba.errors import UserError
from fd_mitsuba.extraction.lattice_box import LatticeBox, touched_cells
from fd_mitsuba.extraction.tet_grid import TetGrid, corner_steps


def test_sizes_and_positions():
    grid = TetGrid(64)
    assert (grid.side, grid.count) == (65, 274625)
    assert grid.spacing == pytest.approx(2.1 / 64)
    assert grid.vertices.shape == (grid.count, 3) and grid.vertices.dtype == torch.float32
    torch.testing.assert_close(grid.vertices[1] - grid.vertices[0], torch.tensor([grid.spacing, 0, 0]))
    torch.testing.assert_close(grid.vertices[-1], torch.full((3,), 1.05))
    index = torch.tensor([7, 1234, 99999])
    assert torch.equal(grid.positions(index), grid.vertices[index])


def test_coordinates_invert_the_numbering():
    grid = TetGrid(5)
    x, y, z = grid.coordinates(torch.arange(grid.count))
    assert torch.equal((z * 6 + y) * 6 + x, torch.arange(grid.count))
    assert int(grid.is_border(torch.arange(grid.count)).sum()) == 6**3 - 4**3


def test_the_tetrahedra_fill_the_cube_once_with_positive_volumes():
    grid = TetGrid(6, half_extent=1.0)
    corners = grid.positions(torch.arange(grid.count), torch.float64)[grid.tets()]
    volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert len(volumes) == 6 * 6**3
    torch.testing.assert_close(volumes, torch.full_like(volumes, grid.spacing**3 / 6))
    # Positive volumes that add up could still overlap: every point must lie in one tetrahedron.
    points = 2 * torch.rand(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1
    local = torch.linalg.solve(
        (corners[:, 1:] - corners[:, :1]).transpose(1, 2)[None], (points[:, None] - corners[:, 0])[..., None]
    )[..., 0]
    assert torch.equal(((local > 0).all(dim=2) & (local.sum(dim=2) < 1)).sum(dim=1), torch.ones(200, dtype=torch.int64))


def test_the_tetrahedra_conform_every_inner_face_belongs_to_two():
    grid = TetGrid(3)
    tets = grid.tets()
    faces = torch.cat([tets[:, [i for i in range(4) if i != skip]] for skip in range(4)]).sort(dim=1).values
    counts = faces.unique(dim=0, return_counts=True)[1]
    assert counts.max() == 2 and int((counts == 1).sum()) == 6 * 9 * 2


def test_corner_steps_follow_the_bits():
    assert corner_steps((1, 10, 100)).tolist() == [0, 1, 10, 11, 100, 101, 110, 111]


def test_too_small_a_grid_is_the_users_error():
    with pytest.raises(UserError, match="grid_resolution = 1"):
        TetGrid(1)


def test_a_box_numbers_vertices_and_edges_like_the_grid():
    grid = TetGrid(8)
    index = torch.tensor([grid.count // 2, grid.count // 2 + 1, grid.count // 2 + 2 * grid.side])
    box = LatticeBox(grid, index)
    assert box.shape == (3, 5, 4)
    numbers = torch.arange(grid.count)
    cut = box.cut(numbers).reshape(-1)
    assert torch.equal(box.local(cut), torch.arange(len(cut)))
    edges = torch.arange(len(cut) * 8)
    assert torch.equal(box.vertices, cut)
    assert torch.equal(box.grid_edges(edges), cut.repeat_interleave(8) * 8 + torch.arange(8).repeat(len(cut)))
    repeated = torch.tensor([5, 3, 5, 59, 3])
    unique, place = box.unique(repeated)
    assert unique.tolist() == [3, 5, 59] and torch.equal(unique[place], repeated)


def test_touched_cells_are_those_with_a_marked_corner():
    marked = torch.zeros(4, 4, 4, dtype=torch.bool)
    marked[1, 2, 0] = True
    cells = touched_cells(marked)
    assert cells.shape == (3, 3, 3) and int(cells.sum()) == 4 and cells[0:2, 1:3, 0].all()
