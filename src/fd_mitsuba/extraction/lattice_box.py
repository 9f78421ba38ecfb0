"""A box of the tetrahedral grid's vertices with its own numbering: bookkeeping that follows the part's size."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.extraction.tet_grid import EDGE_SLOTS, TetGrid
from fd_mitsuba.fields.index_spaces import BoxEdges, BoxVertices, GridEdges, GridVertices


class LatticeBox:
    """The bounding box of vertices `index` and their neighbours.

    Args:
        grid: the grid.
        index: (A,) int64 vertices, none of them on the grid's border; none at all gives a box without vertices.

    Attributes:
        shape: vertices along z, y, x.
        vertices: (M,) int64, the grid's numbers of the box's vertices, ascending.
    """

    def __init__(self, grid: TetGrid, index: GridVertices) -> None:
        self._grid = grid
        self._low: tuple[int, int, int] = (0, 0, 0)
        self.shape: tuple[int, int, int] = (0, 0, 0)
        if len(index):
            ranges = [(int(c.min()) - 1, int(c.max()) + 2) for c in reversed(grid.coordinates(index))]
            self._low = (ranges[0][0], ranges[1][0], ranges[2][0])
            self.shape = tuple(high - low for low, high in ranges)  # type: ignore[assignment]
        self.vertices = GridVertices(self.cut(torch.arange(grid.count)).reshape(-1))

    def cut(self, values: Tensor) -> Tensor:
        """The box's share, (z, y, x), of one value per vertex of the grid, (count,)."""
        (z, y, x), (depth, height, width) = self._low, self.shape
        return values.view((self._grid.side,) * 3)[z : z + depth, y : y + height, x : x + width]

    def local(self, index: GridVertices) -> BoxVertices:
        """The box's numbers of the grid's vertices `index` (M,), all of them in the box."""
        x, y, z = self._grid.coordinates(index)
        _, height, width = self.shape
        return BoxVertices(((z - self._low[0]) * height + (y - self._low[1])) * width + (x - self._low[2]))

    def grid_edges(self, edges: BoxEdges) -> GridEdges:
        """The grid's numbers of the box's edges (E,); ascending stays ascending."""
        return GridEdges(self.vertices[edges >> 3] * EDGE_SLOTS + (edges & (EDGE_SLOTS - 1)))

    def unique(self, local: BoxVertices) -> tuple[BoxVertices, Tensor]:
        """The box's numbers `local` (M,) ascending without repeats, and the place of each there.

        Linear in the box's size, where sorting is not.
        """
        marks = np.zeros(len(self.vertices), dtype=bool)
        marks[local.numpy()] = True
        present = torch.from_numpy(np.flatnonzero(marks))
        place_of = torch.empty(len(marks), dtype=torch.int64)
        place_of.index_copy_(0, present, torch.arange(len(present)))
        return BoxVertices(present), place_of.index_select(0, local)


def touched_cells(marked: Tensor) -> Tensor:
    """The cells (each side one shorter) of which at least one corner of `marked` (z, y, x) is set."""
    for axis in range(3):
        length = max(marked.shape[axis] - 1, 0)
        marked = marked.narrow(axis, 0, length) | marked.narrow(axis, marked.shape[axis] - length, length)
    return marked
