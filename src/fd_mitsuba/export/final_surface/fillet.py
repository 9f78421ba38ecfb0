"""The smooth transition from the base to a part, and what else is rounded: functions of two signed distances.

The training's `soft_union` does two things: it thickens the part near the base, where a nearly level field becomes a
hat's brim by it, and it makes a fillet. Its fillet has a crease where the surfaces meet and starts and ends with a jump
of curvature: fine at the training's cell, a line in the reflection of a final surface. Here both are apart:
`shown_part` is what was seen of the part, and `fillet` joins that to the base.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.fields.union import soft_union

_WIDTH = 1.2
"""Of the fillet, in `k`: five sevenths of it up the part, two over the base."""
_OVER_BASE = 2 / 7 * _WIDTH
_THICK = 0.13
"""What the union adds over the base is the part's from this thickness on, in `k`; its crease is at 0.1 k."""
_FOOT_CELLS, _FOOT_SHARE = 0.3, 0.07
"""How far the part widens towards the base: so many cells, but not more than this share of `k`."""


def foot_width(union_k: float, cell: float) -> float:
    """How far the part widens towards the base, canonical units."""
    return min(_FOOT_CELLS * cell, _FOOT_SHARE * union_k)


def shown_part(base: Tensor, part: Tensor, k: float) -> Tensor:
    """The part (N,) as the training's union shows it, where that is thicker than a film over the base.

    What `soft_union` adds to the part, but nearer to the base than 0.13 k as if that far from it. So what is thicker
    than 0.13 k over the base is as it was, down to the base, and what is not, is no part.
    """
    low = base.clamp(max=-_THICK * k)
    return part + (soft_union(low, part, k) - torch.maximum(low, part))


def fillet(base: Tensor, part: Tensor, k: float) -> Tensor:
    """What (N,) is added to the maximum of two signed distances, so that no crease is left where they meet.

    With w = 1.2 k and t = (base - part) / w + 5/7, clamped to [0, 1], the sum of both is

        part + w (t^6 - 5/7 t^7)

    which is the mean of max(base - u, part) over random u between -5/7 w and 2/7 w with the density of Beta(5, 2): the
    mean of u is 0, so that nothing is added beyond. Where both are equal it is 0.078 k. Over the base it ends sooner
    than up the part, so that it does not run over what lies beside. Curvature, too, sets in and ends without a jump.
    """
    if k == 0:
        return torch.zeros_like(part)
    width, apart = _WIDTH * k, base - part
    t = (apart / width + 5 / 7).clamp(0, 1)
    t6 = t**6
    added = width * (t6 - 5 / 7 * t6 * t) - apart.clamp(min=0)
    return torch.where((t > 0) & (t < 1), added, 0.0)


def fillet_reach(union_k: float, film: float) -> float:
    """How far from the part the fillet is higher than `film` over a flat base, canonical units; 0 if it nowhere is."""
    apart = torch.linspace(0.0, _OVER_BASE * union_k, 1025, dtype=torch.float64)
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
