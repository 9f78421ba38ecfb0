"""The presence loss: no focal region is left without a part. An addition to the paper's losses."""

from __future__ import annotations

from math import ceil

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def loss_presence(
    sdf_part: Float[Tensor, " N"], members: Bool[Tensor, "R N"], share: float, depth: float
) -> Float[Tensor, ""]:
    """What the deepest points of each focal region lack to lie inside the part, as a mean over regions.

        mean over regions of max(depth - mean(the largest `share` of sdf_part in the region), 0)

    Image gradients move surfaces and cannot make a new one: a part that is taken away faster than it is shaped would be
    lost. This keeps a seed of it, wherever the field is highest, and is 0 as soon as the part is larger than that.

    Args:
        sdf_part: (N,) at sample points, inside positive, canonical units.
        members: (R, N) bool, which points may hold the part of each region. A region without points does not count.
        share: of a region's points that must be inside, in (0, 1]; one point at least.
        depth: how deep they must be on average, canonical units.

    Gradients flow to `sdf_part`. No region with points: 0.
    """
    lacking = []
    for row in members:
        count = int(row.sum())
        if count:
            deepest = torch.topk(sdf_part[row], ceil(share * count), sorted=False).values
            lacking.append((depth - deepest.mean()).clamp(min=0))
    return torch.stack(lacking).mean() if lacking else 0.0 * sdf_part.sum()
