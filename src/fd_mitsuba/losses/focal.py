"""The geometric focal loss: the part stays where the user wants it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def loss_focal(
    sdf_part: Float[Tensor, " N"],
    distance: Float[Tensor, " N"],
    sigma_distance: float,
    sigma_sdf: float,
    margin: float = 0.0,
) -> Float[Tensor, ""]:
    """Mean penalty of points that are inside the part but away from the focal regions.

        mean((1 - exp(-distance^2 / sigma_distance)) * tanh(max(sdf_part + margin, 0) / sigma_sdf))

    Paper: L_GF, "Geometry Editing", with sigma_1 = sigma_distance, sigma_2 = sigma_sdf, xi = margin.

    Args:
        sdf_part: (N,) at sample points, inside positive, canonical units.
        distance: (N,) how far the points lie outside the focal regions, >= 0 (0 inside), canonical units; a band in
            which overrunning is free is subtracted by the caller.
        sigma_distance: softness of the region's border, canonical units squared, > 0.
        sigma_sdf: softness of the part's border, canonical units, > 0.
        margin: also punishes an sdf that is negative by less than this, >= 0.

    Gradients flow to `sdf_part`. No points: 0.
    """
    if sdf_part.numel() == 0:
        return sdf_part.sum()
    away = 1 - torch.exp(-(distance * distance) / sigma_distance)
    within = torch.tanh((sdf_part + margin).clamp(min=0) / sigma_sdf)
    return (away * within).mean()
