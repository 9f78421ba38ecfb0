"""How much two pictures differ where they should be equal: PSNR and SSIM over the pixels that count."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d

MOST_DECIBELS = 200.0
"""What equal pictures are given, so that the figure stays a number in JSON."""
_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(one: Tensor, other: Tensor, counted: Tensor) -> float | None:
    """Decibels of pictures (B, C, H, W) in [0, 1] over the pixels of a mask (B, 1, H, W); None if it is empty."""
    counted = counted.expand_as(one)
    if not counted.any():
        return None
    error = float((one.double() - other.double())[counted].square().mean())
    return MOST_DECIBELS if error == 0 else min(-10 * math.log10(error), MOST_DECIBELS)


def ssim(one: Tensor, other: Tensor, counted: Tensor, equal: Tensor | None = None) -> float | None:
    """Mean structural similarity over the windows around some pixels; None if none of these has a whole window.

    Gaussian windows of 11 x 11 pixels with sigma 1.5, population covariance, values in [0, 1], channels averaged: the
    settings of Wang et al. (2004), "Image quality assessment: from error visibility to structural similarity".

    Args:
        one, other: (B, C, H, W).
        counted: (B, 1, H, W) bool: the windows' middles.
        equal: (B, 1, H, W) bool: pixels that should be equal. All others take the value of `other` first, so that a
            window which reaches into what may differ says nothing of it. None: every pixel should.
    """
    if min(one.shape[-2:]) <= 2 * _RADIUS:
        return None
    middles = counted[..., _RADIUS:-_RADIUS, _RADIUS:-_RADIUS].expand(-1, one.shape[1], -1, -1)
    if not middles.any():
        return None
    shown = one if equal is None else torch.where(equal, one, other)
    return float(ssim_map(shown, other)[middles].mean())


def ssim_map(one: Tensor, other: Tensor) -> Tensor:
    """The structural similarity of every whole window: (B, C, H - 10, W - 10) float64."""
    x, y = one.double(), other.double()
    mean_x, mean_y = _blurred(x), _blurred(y)
    var_x, var_y = _blurred(x * x) - mean_x**2, _blurred(y * y) - mean_y**2
    covariance = _blurred(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    return above / ((mean_x**2 + mean_y**2 + _C1) * (var_x + var_y + _C2))


def _blurred(pictures: Tensor) -> Tensor:
    steps = torch.arange(-_RADIUS, _RADIUS + 1, dtype=torch.float64)
    row = torch.exp(-0.5 * (steps / _SIGMA) ** 2)
    row = row / row.sum()
    flat = pictures.reshape(-1, 1, *pictures.shape[-2:])
    flat = conv2d(conv2d(flat, row.view(1, 1, 1, -1)), row.view(1, 1, -1, 1))
    return flat.reshape(*pictures.shape[:2], *flat.shape[-2:])
