"""A hash grid at points that move from step to step: the same function as `HashGrid.forward`, several times faster.

The rows and weights of a point's eight neighbours are found once and kept for the gradient, and the gradient of the
table is summed in place, level by level, so that each level's rows stay in the processor's cache.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fd_mitsuba.fields.hash_grid import HashGrid


def features_at(grid: HashGrid, points: Float[Tensor, "N 3"]) -> Float[Tensor, "features N"]:
    """The features (levels * features, N) at canonical points (N, 3), columns as `ColumnMlp` reads them.

    Points beyond the grid's cube count as its border. Gradients flow to the table, not to the points. The features are
    where the table is.
    """
    return _Features.apply(grid.table, points.detach().to(grid.table.device, grid.table.dtype), grid)


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table: Tensor, points: Tensor, grid: HashGrid) -> Tensor:  # type: ignore[override]
        neighbours = [_neighbours(grid, level, points) for level in range(grid.levels)]
        features = table.new_empty(grid.levels, grid.features, len(points))
        for level, (rows, weights) in enumerate(neighbours):
            for feature in range(grid.features):
                values = table[feature].take(rows)
                torch.sum(values.mul_(weights), dim=0, out=features[level, feature])
        ctx.grid = grid
        ctx.save_for_backward(*(tensor for pair in neighbours for tensor in pair))
        return features.view(grid.width, -1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):  # type: ignore[override]
        grid, saved = ctx.grid, ctx.saved_tensors
        gradient = gradient.contiguous().view(grid.levels, grid.features, -1)
        total = gradient.new_zeros(grid.features, sum(grid.rows))
        for level in range(grid.levels):
            rows, weights = saved[2 * level].view(-1), saved[2 * level + 1]
            for feature in range(grid.features):
                total[feature].scatter_add_(0, rows, (weights * gradient[level, feature]).view(-1))
        return total, None, None


def _neighbours(grid: HashGrid, level: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Table rows (8, N) int64 of the lattice cell's corners, and their trilinear weights (8, N)."""
    cell, fraction = grid.split(level, points.t())
    keys = [torch.stack([grid.axis_key(level, axis, cell[axis] + step) for step in (0, 1)]) for axis in range(3)]
    rows = (keys[2][:, None, None] ^ keys[1][:, None] ^ keys[0]) + grid.first_row[level]
    sides = torch.stack([1 - fraction, fraction])
    weights = sides[:, None, None, 2] * sides[:, None, 1] * sides[:, 0]
    return rows.view(8, -1), weights.view(8, -1)
