"""From linear radiance to the sRGB in [0, 1] that guidance and files want, without losing gradients on the way."""

from __future__ import annotations

import torch
from torch import Tensor

KNEE = 0.8
"""Linear values up to here keep the sRGB curve as it is written; above, they are rolled off towards 1."""

_LUMINANCE = (0.2126, 0.7152, 0.0722)
_LINEAR_END = 0.0031308


def to_srgb(linear: Tensor, exposure: float = 1.0) -> Tensor:
    """sRGB in [0, 1) of linear RGB of any shape; differentiable, and nowhere with a derivative of 0.

    x = exposure * linear; above the knee k it becomes k + (1 - k) u / (1 + u) with u = (x - k) / (1 - k), which has the
    slope 1 at the knee and reaches 1 only at infinity, so that a highlight still says which way is darker. A hard clamp
    would cut the gradient of every pixel that is too bright, and those are the ones that need it. Values below 0 stay
    negative.
    """
    x = linear * exposure
    over = (x - KNEE).clamp(min=0) / (1 - KNEE)
    x = torch.where(x > KNEE, KNEE + (1 - KNEE) * over / (1 + over), x)
    # The power's slope is infinite at 0, and the branch that is not taken must not make NaN of it.
    curve = 1.055 * x.clamp(min=_LINEAR_END) ** (1 / 2.4) - 0.055
    return torch.where(x <= _LINEAR_END, 12.92 * x, curve)


def to_linear(srgb: Tensor) -> Tensor:
    """The linear value, at exposure 1, of sRGB in [0, 1]; without the roll-off, so the inverse only below the knee."""
    low = srgb / 12.92
    return torch.where(srgb <= 0.04045, low, ((srgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def luminance(linear: Tensor) -> Tensor:
    """(B, 1, H, W) of linear RGB (B, 3, H, W)."""
    weights = torch.tensor(_LUMINANCE, dtype=linear.dtype).view(1, 3, 1, 1)
    return (linear * weights).sum(dim=1, keepdim=True)


CLAY_LEVEL = 0.6
"""Linear luminance that the exposure gives to the brightest part of the base in clay, whose base colour is 0.5."""


def auto_exposure(base_path: Tensor, base_mask: Tensor, level: float = 0.8, percentile: float = 95.0) -> float:
    """The factor that gives the brightest part of the base the luminance `level`: one number for a whole run.

    Args:
        base_path: (B, 3, H, W) linear, multiplied by coverage, of views all around.
        base_mask: (B, 1, H, W) the base's coverage; pixels with less than half of it do not count.
        level: linear luminance of the given percentile after exposure.
        percentile: in [0, 100].

    Returns:
        1.0 where no pixel shows the base, or all that do are black.
    """
    counted = base_mask > 0.5
    values = (luminance(base_path) / base_mask.clamp(min=0.5))[counted]
    values = values[torch.isfinite(values)]
    if not len(values):
        return 1.0
    rank = min(int(percentile / 100 * len(values)), len(values) - 1)
    bright = float(values.sort().values[rank])
    return level / bright if bright > 1e-9 else 1.0
