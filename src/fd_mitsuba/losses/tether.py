"""The tether loss: a part does not come loose from the object. An addition to the paper's losses."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def loss_tether(sdf_part: Float[Tensor, " N"], depth: float) -> Float[Tensor, ""]:
    """Mean over points of max(depth - sdf_part, 0): how much they lack to lie `depth` inside the part.

    Args:
        sdf_part: (N,) at points between a loose piece and what it should hang on, inside positive, canonical units.
        depth: canonical units.

    Gradients flow to `sdf_part`. No points: 0.
    """
    lack = (depth - sdf_part).clamp(min=0)
    return lack.mean() if lack.numel() else lack.sum()
