"""The smooth transition from the base to a part, and what else is rounded: functions of two signed distances.

The training's `soft_union` leaves a crease where its two surfaces meet, and starts and ends with a jump of curvature:
fine at the training's cell, a line in the reflection of a final surface.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_FILLET_WIDTH = 1.4
"""In `k`: five sevenths of it up the part, as `soft_union`'s, two over the base."""
_FOOT_CELLS, _FOOT_SHARE = 0.4, 0.09
"""How far the part widens towards the base: so many cells, but not more than this share of `k`."""


def foot_width(union_k: float, cell: float) -> float:
    """How far the part widens towards the base, canonical units."""
    return min(_FOOT_CELLS * cell, _FOOT_SHARE * union_k)


def fillet(base: Tensor, part: Tensor, k: float) -> Tensor:
    """What (N,) is added to the maximum of two signed distances, so that no crease is left where they meet.

    With t = (base - part) / 1.4 k + 5/7, clamped to [0, 1], the sum of both is

        part + 1.4 k (t^6 - 5/7 t^7)

    which is the mean of max(base - u, part) over random u between -k and 0.4 k with the density of Beta(5, 2): the mean
    of u is 0, so that nothing is added beyond. Where both are equal it is 0.091 k, near the 0.1 k of `soft_union`. Up
    the part it is nowhere higher than that, and over the base it ends at 0.4 k, so that it does not run over what lies
    beside the part. Curvature, too, sets in and ends without a jump.
    """
    if k == 0:
        return torch.zeros_like(part)
    width, apart = _FILLET_WIDTH * k, base - part
    t = (apart / width + 5 / 7).clamp(0, 1)
    t6 = t**6
    added = width * (t6 - 5 / 7 * t6 * t) - apart.clamp(min=0)
    return torch.where((t > 0) & (t < 1), added, 0.0)


def fillet_reach(union_k: float, film: float) -> float:
    """How far from the part the fillet is higher than `film` over a flat base, canonical units; 0 if it nowhere is."""
    apart = torch.linspace(0.0, 0.4 * union_k, 1025, dtype=torch.float64)
    height = fillet(apart, torch.zeros_like(apart), union_k)
    if height[0] <= film:
        return 0.0
    return film + float(np.interp(film, height.numpy()[::-1], apart.numpy()[::-1]))


def rounded_minimum(one: Tensor, other: Tensor, width: float) -> Tensor:
    """The lesser (N,) of two values, less what rounds the edge where they differ by less than `width`."""
    overlap = (width - (one - other).abs()).clamp(min=0)
    return torch.minimum(one, other) - overlap * overlap / (4 * width)


def smoothstep(share: Tensor) -> Tensor:
    """3 t^2 - 2 t^3 of the share (N,), t between 0 and 1."""
    share = share.clamp(0, 1)
    return share * share * (3 - 2 * share)
