"""Colour pictures as latents without a VAE: area means of colours and shine, for models that were trained on them."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

Values = TypeVar("Values", Tensor, np.ndarray)


def shine(roughness: Values, metallic: Values) -> Values:
    """How much of a mirror a surface is, in [0, 1]: (4 metallic + 1 - roughness) / 5.

    One number for both, because latents in Stable Diffusion's layout have one channel to spare. Metallic counts so much
    more that roughness cannot make up for it: with equal weights, plain colours became half metal and wholly rough.
    """
    return (4 * metallic + 1 - roughness) / 5


def colour_latents(pictures: Float[Tensor, "N 4 H W"], size: int) -> Float[Tensor, "N 4 {size} {size}"]:
    """(N, 4, size, size), 2 mean - 1, of pictures (N, 4, H, W) in [0, 1]: sRGB, and shine times the part's coverage.

    Nothing is divided by coverage: black stays black. Gradients flow. A picture of 32 x 32 pixels says little about
    metal, a light yellow surface passes for gold; so the network is told, and asked, in so many words.
    """
    return 2 * adaptive_avg_pool2d(pictures, size) - 1
