"""Pictures of a part as optimisation leaves it: rounded off, swollen or worn away, and lumpy.

A denoiser is trained on noisy pictures of parts as they are meant, but guidance asks it about noisy pictures of a part
in the making. At the noise levels that decide about fine shape a lump with the right outline is, to such a denoiser, a
lump. Where the picture under the noise is of the part rounded off, and the answer is still the part as it was meant, it
learns what to make of lumps. Works on mosaics of normal times coverage and 2 coverage - 1, for views of any size.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

RADII = 0.4, 2.0
"""Standard deviation of the rounding, in pixels of views of 32."""
LEVELS = 0.3, 0.7
"""Where the softened outline is cut: below a half the part swells, above it is worn away."""
LUMP_CELLS = 4, 7
"""Lumps a view's side, coarse ones and fine ones in any mixture."""
OUTLINE_LUMPS, NORMAL_LUMPS = 0.15, 0.35
"""Of the level, and of the normals."""
_REFERENCE_SIZE = 32


def rounded(base: Tensor, edited: Tensor, changed: Tensor, generator: torch.Generator) -> Tensor:
    """Edited mosaics with their part rounded off, by another amount in each.

    Args:
        base, edited: (N, 4, L, L), four views in two rows.
        changed: (N, 1, L, L) where the part is, 0 or 1.
        generator: on the mosaics' device.

    Returns:
        (N, 4, L, L).
    """
    count, place = len(base), base.device
    size = base.shape[-1] // 2

    def uniform(low: float, high: float) -> Tensor:
        drawn = torch.rand(count, 1, 1, 1, generator=generator, device=place)
        return (low + (high - low) * drawn).repeat_interleave(4, 0)

    def lumps(channels: int, strength: Tensor) -> Tensor:
        coarse, fine = (
            interpolate(
                torch.randn(4 * count, channels, cells, cells, generator=generator, device=place),
                size=(size, size),
                mode="bicubic",
                align_corners=False,
            )
            for cells in LUMP_CELLS
        )
        return strength * coarse.lerp(fine, uniform(0.0, 1.0))

    below, clean, mask = (_views(picture) for picture in (base, edited, changed))
    sigma = uniform(*RADII) * size / _REFERENCE_SIZE
    share = _softened(torch.cat([mask, clean * mask], 1), sigma, round(3 * RADII[1] * size / _REFERENCE_SIZE))
    level = uniform(*LEVELS) + lumps(1, uniform(0.0, OUTLINE_LUMPS))
    cover = ((share[:, :1] - level) * (2.5 * sigma).clamp(min=1.0) + 0.5).clamp(0, 1)
    part = share[:, 1:] / share[:, :1].clamp(min=1e-4)
    coverage = (0.5 + 0.5 * part[:, 3:]).clamp(0, 1)
    normal = part[:, :3] + lumps(3, uniform(0.0, NORMAL_LUMPS))
    normal = normal / normal.norm(dim=1, keepdim=True).clamp(min=1e-4) * coverage
    shown = torch.cat([normal, part[:, 3:]], 1)
    return _mosaics(torch.where(share[:, :1] > 1e-3, below + cover * (shown - below), below))


def _softened(values: Tensor, sigma: Tensor, reach: int) -> Tensor:
    """Gaussian blur of each view (M, C, S, S) by its own sigma (M, 1, 1, 1) in pixels; zero outside of a view.

    Args:
        reach: of the kernel in pixels, a plain number: to look up the largest sigma would wait for a card.
    """
    offset = torch.arange(-reach, reach + 1, device=values.device, dtype=values.dtype)
    kernel = torch.exp(-0.5 * (offset / sigma.reshape(-1, 1)) ** 2)
    kernel = kernel / kernel.sum(1, keepdim=True)
    for axis in (2, 3):
        border = (0, 0, reach, reach) if axis == 2 else (reach, reach, 0, 0)
        windows = pad(values, border).unfold(axis, 2 * reach + 1, 1)
        values = torch.einsum("mcijk,mk->mcij", windows, kernel)
    return values


def _views(mosaics: Tensor) -> Tensor:
    """(N, C, L, L) -> (4 N, C, L / 2, L / 2)."""
    count, channels, side, _ = mosaics.shape
    tiles = mosaics.reshape(count, channels, 2, side // 2, 2, side // 2).permute(0, 2, 4, 1, 3, 5)
    return tiles.reshape(4 * count, channels, side // 2, side // 2)


def _mosaics(views: Tensor) -> Tensor:
    """The reverse of `_views`."""
    count, channels, size, _ = views.shape
    tiles = views.reshape(count // 4, 2, 2, channels, size, size).permute(0, 3, 1, 4, 2, 5)
    return tiles.reshape(count // 4, channels, 2 * size, 2 * size)
