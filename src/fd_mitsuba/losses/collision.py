"""Collision avoidance: the part does not grow into the base."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def loss_collision(sdf_base: Float[Tensor, " N"], sdf_part: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    """Mean over sample points of `max(sdf_base, 0) * max(sdf_part, 0)`. Paper: L_CA, "Geometry Editing".

    Args:
        sdf_base: (N,) inside positive, canonical units.
        sdf_part: (N,) at the same points.

    Gradients flow to both. No points: 0.
    """
    product = sdf_base.clamp(min=0) * sdf_part.clamp(min=0)
    return product.mean() if product.numel() else product.sum()
