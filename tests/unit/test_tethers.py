"""Loose pieces of a part are found, and the vertices that would hang them on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fd_mitsuba.extraction.marching_tets import crossing_faces_plain
from fd_mitsuba.extraction.pieces import label_pieces
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.losses.tether import loss_tether
from fd_mitsuba.training.tethers import Tethers, tether_vertices

SHAPE = (7, 8, 9)


def block(*ranges: tuple[int, int]) -> np.ndarray:
    marked = np.zeros(SHAPE, dtype=bool)
    marked[tuple(slice(*pair) for pair in ranges)] = True
    return marked


BASE = block((2, 5), (0, 2), (2, 6))
ANYWHERE = np.ones(SHAPE, dtype=bool)
CROWN = block((3, 4), (5, 7), (3, 5))


def places(flat: np.ndarray) -> list[tuple[int, ...]]:
    return [tuple(int(i) for i in place) for place in np.array(np.unravel_index(flat, SHAPE)).T]


def test_a_loose_piece_is_tied_to_the_base_by_the_shortest_line() -> None:
    assert places(tether_vertices(CROWN, BASE, ANYWHERE)) == [(3, 2, 3), (3, 3, 3), (3, 4, 3), (3, 5, 3)]


def test_what_hangs_on_is_left_alone() -> None:
    stalk = block((3, 4), (2, 5), (4, 5))
    assert not len(tether_vertices(CROWN | stalk, BASE, ANYWHERE))
    assert not len(tether_vertices(BASE & CROWN, BASE, ANYWHERE))
    assert not len(tether_vertices(CROWN, np.zeros_like(BASE), ANYWHERE))


def test_a_piece_may_hang_on_another_one() -> None:
    stump = block((3, 4), (2, 4), (3, 4))
    assert places(tether_vertices(CROWN | stump, BASE, ANYWHERE)) == [(3, 3, 3), (3, 4, 3), (3, 5, 3)]


def test_what_cannot_be_reached_within_the_room_is_meant_to_float() -> None:
    room = ANYWHERE & ~block((0, 7), (3, 4), (0, 9))
    assert not len(tether_vertices(CROWN, BASE, room))
    part = CROWN | block((3, 4), (3, 4), (3, 4))  # the part has been there already
    assert places(tether_vertices(part, BASE, room)) == [(3, 2, 3), (3, 4, 3), (3, 5, 3)]


def test_crumbs_are_left_alone() -> None:
    large = block((0, 7), (2, 5), (0, 9))
    crumb = block((3, 4), (7, 8), (3, 4))
    assert large.sum() > 50 / 0.98 and not len(tether_vertices(large | crumb, BASE, ANYWHERE))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.4))
def test_with_its_tethers_everything_hangs_together(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    part = (rng.random(SHAPE) < share) & ~BASE
    label, count = label_pieces(part | BASE)
    tied = part.copy()
    tied.reshape(-1)[tether_vertices(part, BASE, ANYWHERE)] = True
    after, _ = label_pieces(tied | BASE)
    sizes = np.bincount(label[part], minlength=count + 1)
    for number in range(1, count + 1):
        if sizes[number] >= max(1, 0.02 * part.sum()):
            assert (after[label == number] == after[BASE][0]).all()


def test_pieces_are_those_of_the_surface() -> None:
    """As many closed pieces as marching tetrahedra make, at random marks away from the border."""
    grid = TetGrid(7)
    marked = torch.zeros((8, 8, 8), dtype=torch.bool)
    marked[1:-1, 1:-1, 1:-1] = torch.from_numpy(np.random.default_rng(1).random((6, 6, 6)) < 0.12)
    _, count = label_pieces(marked.numpy())
    ends, faces = crossing_faces_plain(marked.view(-1), grid.tets())
    owner = np.arange(len(ends))
    for a, b, c in faces.tolist():  # union of the vertices of each face
        low = min(owner[a], owner[b], owner[c])
        for vertex in (a, b, c):
            owner[owner == owner[vertex]] = low
    assert count == len(np.unique(owner)) > 3


def test_the_grid_s_vertices_are_named() -> None:
    """A ball above a ball, in the grid's own numbers: the tethers lie between them, on the axis."""
    grid = TetGrid(32)
    x, y, z = grid.vertices.unbind(1)
    below = 0.4 - (x**2 + (y + 0.5) ** 2 + z**2).sqrt()
    above = 0.2 - (x**2 + (y - 0.45) ** 2 + z**2).sqrt()
    active = ((y > -0.3) & (y < 0.8) & (x.abs() < 0.5) & (z.abs() < 0.5)).nonzero()[:, 0]
    everywhere = torch.ones(grid.count, dtype=torch.bool)
    tethers = Tethers(grid, below, everywhere, active).find(above[active] > 0)
    found = grid.vertices[tethers]
    assert len(found) >= 4 and torch.isin(tethers, active).all()
    assert float(found[:, [0, 2]].abs().max()) <= grid.spacing
    assert float(found[:, 1].min()) > -0.1 and float(found[:, 1].max()) < 0.35
    nowhere = Tethers(grid, below, ~everywhere, active)
    assert len(nowhere.find(above[active] > 0)) == 0


def test_the_loss_by_hand() -> None:
    sdf = torch.tensor([-0.1, 0.02, 0.5], requires_grad=True)
    loss = loss_tether(sdf, 0.04)
    loss.backward()
    assert loss.item() == pytest.approx((0.14 + 0.02) / 3)
    assert sdf.grad.tolist() == pytest.approx([-1 / 3, -1 / 3, 0])
    assert loss_tether(sdf[:0], 0.04).item() == 0
