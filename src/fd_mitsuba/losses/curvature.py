"""What curvature of the part's surface costs: dents smaller than what the guidance sees are noise."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

STENCIL = tuple((x, y, z) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if abs(x) + abs(y) + abs(z) < 3)
"""A vertex of the grid and the 18 around it that share a face or an edge of a cell with it, as steps along x, y, z."""

_PLACE = {step: place for place, step in enumerate(STENCIL)}
_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_LEAST_SLOPE = 0.1


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
    values = sdf_part / spacing

    def at(*steps: tuple[int, int, int]) -> Tensor:
        return values[:, _PLACE[tuple(int(sum(axis)) for axis in zip(*steps, strict=True))]]  # type: ignore[index]

    back = tuple(tuple(-number for number in axis) for axis in _AXES)
    slope = torch.stack([(at(axis) - at(away)) / 2 for axis, away in zip(_AXES, back, strict=True)], dim=1)
    bend = torch.stack(
        [
            torch.stack(
                [
                    at(_AXES[i]) + at(back[i]) - 2 * at((0, 0, 0))
                    if i == j
                    else (at(_AXES[i], _AXES[j]) - at(_AXES[i], back[j]) - at(back[i], _AXES[j]) + at(back[i], back[j]))
                    / 4
                    for j in range(3)
                ],
                dim=1,
            )
            for i in range(3)
        ],
        dim=1,
    )
    length = slope.norm(dim=1, keepdim=True).clamp(min=_LEAST_SLOPE)
    normal = slope / length
    flat = torch.eye(3, dtype=values.dtype) - normal[:, :, None] * normal[:, None, :]
    squared = ((flat @ bend @ flat) / length[..., None]).square().sum(dim=(1, 2))
    return (squared / (1 + squared / edge**2)).mean()
