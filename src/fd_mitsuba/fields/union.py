"""The geometry union of base and part."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def soft_union(
    sdf_base: Float[Tensor, "*points"], sdf_part: Float[Tensor, "*points"], k: float, only_outside: bool = False
) -> Float[Tensor, "*points"]:
    """The signed distance of base and part together, with a fillet of width `k` where their surfaces meet.

        soft_union = max(sdf_base, sdf_part) + 0.1 h^2 / k,   h = max(k - |sdf_base - sdf_part|, 0)

    Exactly `sdf_base` where the part is lower by `k` or more. `k = 0` is the plain maximum. Paper: eq. 3-4.

    Args:
        sdf_base: any shape, inside positive, canonical units.
        sdf_part: same shape.
        k: width of the fillet in canonical units, >= 0.
        only_outside: blend only where both are negative, so that neither solid swells inside the other.

    Gradients flow to both. Their kink where both are equal is that of the maximum minus that of the fillet: the
    factor 0.1 of the paper leaves part of it (a factor of 0.25 would remove it).
    """
    larger = torch.maximum(sdf_base, sdf_part)
    if k == 0:
        return larger
    overlap = (k - (sdf_base - sdf_part).abs()).clamp(min=0)
    if only_outside:
        overlap = torch.where(larger < 0, overlap, 0.0)
    return larger + 0.1 / k * overlap * overlap


def soft_subtract(
    sdf_base: Float[Tensor, "*points"], sdf_part: Float[Tensor, "*points"], k: float
) -> Float[Tensor, "*points"]:
    """The signed distance of the base without the part, with a fillet of width `k` along the edge of the cut.

        soft_subtract = min(sdf_base, -sdf_part) - 0.1 h^2 / k,   h = max(k - |sdf_base + sdf_part|, 0)

    The outside of the result is the soft union of the base's outside and the part, so this is `soft_union` with all
    three turned inside out. Exactly `sdf_base` where `-sdf_part` is higher by `k` or more.

    Args:
        sdf_base: any shape, inside positive, canonical units.
        sdf_part: same shape.
        k: width of the fillet in canonical units, >= 0.

    Gradients flow to both, with the kink of `soft_union`.
    """
    return -soft_union(-sdf_base, sdf_part, k)
