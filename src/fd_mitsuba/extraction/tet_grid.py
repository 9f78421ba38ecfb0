"""The tetrahedral grid: a cubic lattice whose cells are cut into six tetrahedra along their main diagonal.

The cut is Kuhn's (also called Freudenthal's): one tetrahedron per order in which the axes can be walked from a cell's
lowest corner to its highest. Neighbouring cells agree on every shared face, and all edges run along seven directions.

Numbering, used everywhere
    vertex     (z * side + y) * side + x, x fastest
    corner     of a cell: bit 0 is x, bit 1 is y, bit 2 is z
    direction  of an edge: the corner (1..7) that it reaches from its lower end
    edge       lower vertex * 8 + direction, so that ascending edges are ordered by both their ends
"""

from __future__ import annotations

from functools import cached_property
from itertools import permutations

import torch
from torch import Tensor

from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.errors import UserError

EDGE_SLOTS = 8
"""Numbers that each vertex reserves for edges; the first stays unused."""


def _kuhn_cell() -> tuple[tuple[int, int, int, int], ...]:
    cell = []
    for order in permutations(range(3)):
        first, second = 1 << order[0], (1 << order[0]) | (1 << order[1])
        even = order in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        cell.append((0, first, second, 7) if even else (0, second, first, 7))
    return tuple(cell)


KUHN_CELL = _kuhn_cell()
"""The corners of a cell's six tetrahedra, each with positive volume."""


def corner_steps(strides: tuple[int, int, int]) -> Tensor:
    """How far (8,) int64 each corner of a cell is from its lowest one in a lattice with these (x, y, z) strides."""
    return torch.tensor([sum(strides[axis] for axis in range(3) if corner >> axis & 1) for corner in range(8)])


class TetGrid:
    """A lattice of (resolution + 1)^3 vertices over a cube around the canonical origin.

    Args:
        resolution: cells a side.
        half_extent: the cube is [-half_extent, half_extent]^3, canonical units.

    Raises:
        UserError: fewer than two cells a side.
    """

    def __init__(self, resolution: int, half_extent: float = GRID_HALF_EXTENT) -> None:
        if resolution < 2:
            raise UserError(f"geometry.grid_resolution = {resolution}: the grid needs 2 cells a side or more")
        self.resolution = resolution
        self.half_extent = half_extent
        self.side = resolution + 1
        self.count = self.side**3
        self.spacing = 2 * half_extent / resolution
        self.axis = torch.linspace(-half_extent, half_extent, self.side, dtype=torch.float64)
        """(side,) float64 coordinates of the vertices along each axis."""

    @cached_property
    def vertices(self) -> Tensor:
        """All vertices (count, 3), float32, canonical; made when first asked for."""
        return self.positions(torch.arange(self.count))

    def positions(self, index: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Canonical positions (M, 3) of vertices `index` (M,)."""
        axis = self.axis.to(dtype)
        return axis[torch.stack(self.coordinates(index), dim=1)]

    def coordinates(self, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Lattice coordinates x, y, z (each (M,) int64) of vertices `index` (M,)."""
        return index % self.side, index // self.side % self.side, index // (self.side * self.side)

    def is_border(self, index: Tensor) -> Tensor:
        """Whether vertices `index` (M,) lie on the surface of the grid's cube, (M,) bool."""
        low_or_high = [(c == 0) | (c == self.resolution) for c in self.coordinates(index)]
        return low_or_high[0] | low_or_high[1] | low_or_high[2]

    def tets(self) -> Tensor:
        """All 6 resolution^3 tetrahedra (T, 4) as vertex numbers, of positive volume; 50 MB at 64, 400 at 128."""
        steps = corner_steps((1, self.side, self.side**2))[torch.tensor(KUHN_CELL)]
        cell = torch.arange(self.resolution)
        lowest = (cell[:, None, None] * self.side + cell[:, None]) * self.side + cell
        return (lowest.reshape(-1, 1, 1) + steps).view(-1, 4)
