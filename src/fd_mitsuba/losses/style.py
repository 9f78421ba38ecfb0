"""Style consistency: the part's material is smooth, and continues the base's where the two meet.

Paper: "Style Consistency". Together the two imitate an interpolation of the base's material into the part: the first
is its smoothness term, the second its boundary condition. The paper's L_SC = L_g + lambda_b L_b; weights are outside.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def jittered(points: Float[Tensor, "N 3"], deviation: float, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """`points + delta` with delta normal in each coordinate: the second place that `loss_style_gradient` compares.

    Args:
        points: (N, 3) canonical.
        deviation: standard deviation of each coordinate of delta, canonical units.
        generator: the source of delta.
    """
    return points + deviation * torch.randn(points.shape, generator=generator, dtype=points.dtype)


def loss_style_gradient(here: Float[Tensor, "N C"], moved: Float[Tensor, "N C"]) -> Float[Tensor, ""]:
    """Mean over points of `|part(x) - part(x + delta)|^2`. Paper: L_g, "Style Consistency".

    Deviates: the paper means every channel; callers pass kd and krm, since a normal map may well vary.

    Args:
        here: (N, C) the part's material at points of its surface.
        moved: (N, C) the same channels at the points plus a small random delta.

    Gradients flow to both. No points: 0.
    """
    return _mean_square(here - moved)


def loss_style_boundary(part: Float[Tensor, "N C"], base: Float[Tensor, "N C"]) -> Float[Tensor, ""]:
    """Mean over boundary points of `|part(x) - base(x)|^2`. Paper: L_b, "Style Consistency".

    Args:
        part: (N, C) the part's material at points of its surface that lie at the base.
        base: (N, C) the same channels of the base at the nearest points of its surface.

    Gradients flow to `part` alone: the base's material is given. No points: 0.
    """
    return _mean_square(part - base.detach())


def _mean_square(difference: Tensor) -> Tensor:
    squared = difference.square().sum(dim=-1)
    return squared.mean() if squared.numel() else squared.sum()
