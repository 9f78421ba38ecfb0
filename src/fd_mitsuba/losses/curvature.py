"""What curvature of the part's surface costs: dents smaller than what the guidance sees are noise."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

STENCIL = tuple((x, y, z) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if abs(x) + abs(y) + abs(z) < 3)
"""A vertex of the grid and the 18 around it that share a face or an edge of a cell with it, as steps along x, y, z."""

_LEAST_SLOPE = 0.1
_MIXED = ((0, 1), (0, 2), (1, 2))


def _differences() -> Tensor:
    """(19, 9): central differences of values at `STENCIL`: along x, y, z; xx, yy, zz; xy, xz, yz."""
    rows = np.zeros((len(STENCIL), 9), np.float32)
    for row, step in zip(rows, STENCIL, strict=True):
        for axis in range(3):
            alone = abs(step[axis]) == sum(map(abs, step)) == 1
            row[axis] = step[axis] / 2 if alone else 0
            row[3 + axis] = 1 if alone else -2 if not any(step) else 0
        for column, (one, other) in enumerate(_MIXED, 6):
            row[column] = step[one] * step[other] / 4
    return torch.from_numpy(rows)


_DIFFERENCES = _differences()
_SYMMETRIC = torch.tensor([[3, 6, 7], [6, 4, 8], [7, 8, 5]])
"""Columns of the second differences as a matrix."""


def loss_curvature(sdf_part: Float[Tensor, "N 19"], spacing: float, edge: float = 0.5) -> Float[Tensor, ""]:
    """Mean over points of `c / (1 + c / edge^2)`, with `c` the sum of the squared principal curvatures, per cell.

    Not in the paper. Curvatures are those of the level set through each point: of the second differences of the field,
    seen along the surface, over its slope. So a plane costs nothing, however steep the field, and a ball of a radius of
    r cells `2 / r^2`. An edge turns by far more than a dent, and costs no more than `edge^2`: it can stay.

    Args:
        sdf_part: (N, 19) the field at points near its surface and around them, in the order of `STENCIL`, canonical
            units.
        spacing: side of a grid cell, canonical units.
        edge: what turns by more than this angle in a cell counts as an edge, radians.

    Gradients flow to `sdf_part`. No points: 0.
    """
    if not len(sdf_part):
        return sdf_part.sum()
    differences = sdf_part / spacing @ _DIFFERENCES.to(sdf_part.dtype)
    slope = differences[:, :3]
    bend = differences[:, _SYMMETRIC]
    length = slope.norm(dim=1, keepdim=True).clamp(min=_LEAST_SLOPE)
    normal = slope / length
    flat = torch.eye(3, dtype=slope.dtype) - normal[:, :, None] * normal[:, None, :]
    squared = ((flat @ bend @ flat) / length[..., None]).square().sum(dim=(1, 2))
    return (squared / (1 + squared / edge**2)).mean()
