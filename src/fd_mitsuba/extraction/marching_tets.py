"""Marching tetrahedra: the zero set of values on a lattice as a welded triangle mesh.

Topology depends on signs only (`crossing_faces` fast, `crossing_faces_plain` the oracle), positions on values only
(`crossing_fraction`), so gradients need no more than the latter. Conventions:

* inside is value > 0; exactly 0 counts as outside;
* faces wind counter-clockwise seen from outside, every crossed edge is one vertex, and away from the lattice's border
  the mesh is closed.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from fd_mitsuba.extraction.tet_grid import EDGE_SLOTS, KUHN_CELL, corner_steps

_NEAREST = 1e-3
_SMALLEST_DIFFERENCE = 0.02


def crossing_fraction(inside_value: Tensor, outside_value: Tensor, spacing: float) -> Tensor:
    """Where the zero lies on crossed edges, as a fraction (E,) of the way from the inside to the outside end.

        difference = inside_value - outside_value,   lack = max(epsilon - difference, 0)
        fraction = (inside_value + lack / 2) / (difference + lack), squeezed into [0.001, 0.999]

    The linear zero, with two guards. Values that differ by less than epsilon = 0.02 spacing are pushed apart evenly,
    so that a flat field gives gradients of at most spacing / epsilon = 50 instead of unbounded ones. And vertices stay
    a thousandth of an edge away from the lattice's vertices (an affine map, so gradients survive), so that no two
    vertices coincide and no face has zero area.

    Args:
        inside_value: (E,) > 0.
        outside_value: (E,) <= 0.
        spacing: the lattice's spacing, in the values' units.

    Gradients flow to both values.
    """
    difference = inside_value - outside_value
    lack = (_SMALLEST_DIFFERENCE * spacing - difference).clamp(min=0)
    fraction = (inside_value + 0.5 * lack) / (difference + lack)
    return _NEAREST + (1 - 2 * _NEAREST) * fraction


def edge_ends(edges: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """The lower and the upper vertex (each (E,) int64) of edges (E,) of a lattice with (z, y, x) vertices."""
    lower = edges >> 3
    steps = corner_steps((1, shape[2], shape[1] * shape[2]))
    return lower, lower + steps.index_select(0, edges & (EDGE_SLOTS - 1))


def crossing_faces(inside: Tensor, cells: Tensor | None = None, lookup: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The crossed edges and the faces between them, looking only at cells that have both signs.

    A cell's eight signs select its triangles from a table of 256 cases.

    Args:
        inside: (z, y, x) bool, a sign per lattice vertex.
        cells: (z - 1, y - 1, x - 1) bool, cells to visit; None: all.
        lookup: (8 z y x) int32 to work in, of any content, for callers that come back: memory that is new each time
            costs a third of everything here on a fine grid.

    Returns:
        edges (E,) int64 ascending, numbered as in `tet_grid`, and faces (F, 3) int64, positions in `edges`.
    """
    _, height, width = inside.shape
    cases = _cell_cases(inside.numpy())
    if cells is not None:
        cases[:-1, :-1, :-1] *= cells.numpy()
    lowest = np.flatnonzero((cases != 0) & (cases != 255))
    case = cases.reshape(-1)[lowest].astype(np.int64)
    table, counts = _cell_table()
    steps = corner_steps((1, width, height * width))
    edge_offsets = (steps[table[..., 0]] * EDGE_SLOTS + table[..., 1]).view(-1, 3)
    count = counts.numpy()[case]
    ends = count.cumsum()
    # Per face: its row in the table, and the first edge number of its cell's lowest corner.
    row = torch.from_numpy(np.repeat(case * table.shape[1] - (ends - count), count))
    row += torch.arange(len(row))
    corner_edges = edge_offsets.index_select(0, row)
    corner_edges += torch.from_numpy(np.repeat(lowest * EDGE_SLOTS, count))[:, None]
    # Welding: marks and a lookup over the lattice's edges are linear in time and keep the order defined.
    corner_edges = corner_edges.view(-1)
    marks = np.zeros(inside.numel() * EDGE_SLOTS, dtype=bool)
    marks[corner_edges.numpy()] = True
    edges = torch.from_numpy(np.flatnonzero(marks))
    place = torch.empty(len(marks), dtype=torch.int32) if lookup is None else lookup
    place.index_copy_(0, edges, torch.arange(len(edges), dtype=torch.int32))
    return edges, place.index_select(0, corner_edges).long().view(-1, 3)


def _cell_cases(inside: np.ndarray) -> np.ndarray:
    """The eight signs of each cell as a number, bit by bit in the order of the corners; (z, y, x) uint8 like `inside`.

    A cell's number is at its lowest vertex, so that positions are vertex numbers; vertices without a cell have 0.
    """
    _, height, width = inside.shape
    cases = inside.astype(np.uint8, order="C")
    flat = cases.reshape(-1)
    for factor, step in ((2, 1), (4, width), (16, height * width)):
        # One run over all rows is twice as fast as row by row, but steps over the border, which has no cells. NumPy
        # multiplies bytes ten times as fast as it shifts them.
        flat[:-step] |= flat[step:] * np.uint8(factor)
    cases[-1], cases[:, -1], cases[:, :, -1] = 0, 0, 0
    return cases


def true_positions(marks: Tensor) -> Tensor:
    """The positions (int64, ascending) of what is set in a bool tensor, flattened; NumPy is three times faster here."""
    return torch.from_numpy(np.flatnonzero(marks.numpy()))


def away_from_crossings(sdf: Tensor) -> Tensor:
    """The vertices of which all neighbours within the surrounding eight cells have the same sign, (z, y, x) bool."""
    sign = (sdf > 0).float()[None, None]
    highest = max_pool3d(sign, 3, stride=1, padding=1)
    lowest = -max_pool3d(-sign, 3, stride=1, padding=1)
    return (highest == lowest)[0, 0]


def crossing_faces_plain(inside: Tensor, tets: Tensor) -> tuple[Tensor, Tensor]:
    """The same for any tetrahedra, one case after another: the reference that `crossing_faces` is tested against.

    Args:
        inside: (N,) bool.
        tets: (T, 4) int64, each with positive volume.

    Returns:
        ends (E, 2) int64, the lower and upper vertex of each crossed edge, ascending; faces (F, 3) int64 into them.
    """
    case = (inside[tets].long() * torch.tensor([1, 2, 4, 8])).sum(dim=1)
    faces = []
    for number in range(1, 15):
        members = tets[case == number]
        for triangle in _tet_triangles(number):
            ends = torch.stack([members[:, list(pair)] for pair in triangle], dim=1)
            faces.append(ends.sort(dim=2).values)
    ends = torch.cat(faces).view(-1, 2)
    keys, position = (ends[:, 0] * len(inside) + ends[:, 1]).unique(return_inverse=True)
    return torch.stack([keys // len(inside), keys % len(inside)], dim=1), position.view(-1, 3)


def _tet_triangles(case: int) -> list[tuple[tuple[int, int], ...]]:
    """The triangles of a positive tetrahedron with the corners in `case`'s bits inside; a vertex is its edge's ends."""
    within = [corner for corner in range(4) if case >> corner & 1]
    if len(within) in (0, 4):
        return []
    if len(within) == 3:
        return [triangle[::-1] for triangle in _tet_triangles(15 - case)]
    order = within + [corner for corner in range(4) if corner not in within]
    swaps = sum(order[i] > order[j] for i in range(4) for j in range(i + 1, 4))
    a, b, c, d = order if swaps % 2 == 0 else (*order[:2], order[3], order[2])
    if len(within) == 1:
        return [((a, b), (a, c), (a, d))]
    return [((a, c), (a, d), (b, d)), ((a, c), (b, d), (b, c))]


@cache
def _cell_table() -> tuple[Tensor, Tensor]:
    """Per case, the triangles' edges (256, 12, 3, 2) as lower corner and direction, and how many triangles (256,)."""
    rows, counts = [], []
    for case in range(256):
        row = []
        for tet in KUHN_CELL:
            signs = sum(1 << i for i, corner in enumerate(tet) if case >> corner & 1)
            for triangle in _tet_triangles(signs):
                ends = [sorted((tet[first], tet[second])) for first, second in triangle]
                row.append([[lower, upper - lower] for lower, upper in ends])
        counts.append(len(row))
        rows.append(row + [[[0, 1]] * 3] * (12 - len(row)))
    return torch.tensor(rows), torch.tensor(counts)
