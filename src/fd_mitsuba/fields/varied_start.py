"""Where a part's field starts, varied by the seed: the focal region with some of its surface pressed inwards.

    start(p) = region(p) - variety * depth * waves(p)
    waves(p) = (1 + mean over i of cos(a_i x) sin(b_i y + c_i z + d_i) / spread) / 2, cut to [0, 1]

with `depth` the region's deepest point, so that a start never leaves its region and never vanishes. The waves are as
long as the region and half as long, and the same at x and -x of the canonical frame: left and right stay alike.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_WAVES = 10
_SPREAD = 0.4
"""Such means of sines seldom exceed it; what does is cut off."""


def varied_start(region_sdf: np.ndarray, points: np.ndarray, variety: float, seed: int) -> np.ndarray:
    """(N,) float32 start of the part's field in one region, nowhere above `region_sdf`.

    Args:
        region_sdf: (N,) signed distance to the region, inside positive, canonical units.
        points: (N, 3) where, canonical frame.
        variety: 0: the region itself; 1: in places pressed in as far as its deepest point.
        seed: decides the waves.
    """
    inside = region_sdf > 0
    if variety == 0 or not inside.any():
        return region_sdf
    depth = float(region_sdf.max())
    length = float(np.ptp(np.concatenate([np.abs(points[:, :1]), points[:, 1:]], axis=1)[inside], axis=0).max())
    random = np.random.default_rng(seed)
    directions = random.normal(size=(_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phase = random.uniform(0, 2 * np.pi, _WAVES)
    turns = 2 * np.pi / (length * np.where(np.arange(_WAVES) % 2, 0.5, 1.0))
    across, along = points[:, :1] * directions[:, 0] * turns, (points[:, 1:] @ directions[:, 1:].T) * turns + phase
    waves = np.clip((1 + (np.cos(across) * np.sin(along)).mean(axis=1) / _SPREAD) / 2, 0, 1)
    return (region_sdf - variety * depth * waves).astype(np.float32)


def start_of_regions(regions: Tensor, points: np.ndarray, variety: float, seed: int) -> Tensor:
    """(N,) the largest of the `varied_start` of several regions; with `variety` 0 their union itself.

    Args:
        regions: (R, N) as `region_sdf` there.
    """
    if variety == 0:
        return regions.amax(dim=0)
    return torch.from_numpy(np.stack([varied_start(r.numpy(), points, variety, seed) for r in regions])).amax(dim=0)
