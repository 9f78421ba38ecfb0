"""Colour pictures as latents without a VAE: area means, for models that were trained on them."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

LUMA = (0.299, 0.587, 0.114)


def colour_latents(pictures: Tensor, size: int) -> Tensor:
    """(N, 4, size, size) of sRGB pictures (N, 3, H, W) in [0, 1]: 2 mean c - 1, and 2 mean luma - 1. Gradients flow.

    Nothing is divided by coverage: black stays black. The fourth channel repeats what the others say in one number, so
    that noise hides brightness less than hue.
    """
    means = adaptive_avg_pool2d(pictures, size)
    luma = (means * means.new_tensor(LUMA).view(1, 3, 1, 1)).sum(1, keepdim=True)
    return 2 * torch.cat([means, luma], dim=1) - 1
