"""Vertices of the grid beside the part's surface, each with those around it, for losses on the surface's shape."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.losses.curvature import STENCIL


class SurfaceStencils:
    """Chooses stencils at random where the part's surface is seen.

    Args:
        grid: the grid.
        sdf_base: (count,) base sdf at its vertices, inside positive: what is inside nobody sees.
        active_index: (A,) int64 vertices at which the part exists.
        count: how many are chosen, at most.
    """

    def __init__(self, grid: TetGrid, sdf_base: Tensor, active_index: GridVertices, count: int) -> None:
        strides = torch.tensor([1, grid.side, grid.side**2])
        self._steps = torch.tensor(STENCIL) @ strides
        self._sides = torch.cat([strides, -strides])
        self._active, self._count, self._vertices = active_index, count, grid.count
        active = torch.zeros(grid.count, dtype=torch.bool)
        active[active_index] = ~grid.is_border(active_index)
        centres = GridVertices(active_index[active[active_index] & (sdf_base[active_index] <= 0)])
        self._centres = GridVertices(centres[active[centres[:, None] + self._steps].all(dim=1)])

    def find(self, deeper: Tensor, seed: int) -> GridVertices:
        """The vertices (K * 19,) int64 of K stencils whose centres are in the part, and have a neighbour that is not.

        Args:
            deeper: (A,) bool, where the part is, or is deeper than some depth, at the active vertices.
            seed: of the choice.
        """
        part = torch.zeros(self._vertices, dtype=torch.bool)
        part[self._active] = deeper
        centres = self._centres[part[self._centres]]
        centres = centres[~part[centres[:, None] + self._sides].all(dim=1)]
        chosen = torch.randperm(len(centres), generator=torch.Generator().manual_seed(seed))[: self._count]
        return GridVertices((centres[chosen].sort().values[:, None] + self._steps).flatten())
