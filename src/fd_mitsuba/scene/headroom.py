"""Room for a part that stands out of the grid: the canonical frame then follows the base and its regions together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.region_place import share_in_grid

FITS = 0.999
"""A region with this share of its volume in the paper's grid leaves the paper's frame as it is."""
LEAST_SCALE = 0.5
"""The base keeps at least this share of its size in the paper's frame."""
_SIDE = 2 * GRID_HALF_EXTENT - 0.15
"""Longest side of base and regions together, so that the part may go a little beyond its region."""


def frame_with_headroom(frame: Normalisation, used: np.ndarray, regions: Sequence[FocalRegion]) -> Normalisation:
    """The frame in which base and regions fit the grid: `frame` itself wherever they do already.

    Otherwise the middle of their common box goes to the origin and its longest side becomes 1.95, if it is longer.
    Where that would make the base smaller than half its size, `frame` stays, and the region is refused.
    Deviates from the paper, whose frame follows the base alone: there, nothing tall can stand on a tall base.

    Args:
        frame: the paper's.
        used: (N, 3) the base's vertices, user frame.
        regions: in the paper's frame.
    """
    if all(share_in_grid(region) >= FITS for region in regions):
        return frame
    corners = [frame.to_canonical(np.stack([used.min(axis=0), used.max(axis=0)]))]
    corners += [np.stack(region.bounds) for region in regions]
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    shrink = min(1.0, _SIDE / float((high - low).max()))
    if shrink < LEAST_SCALE:
        return frame
    return Normalisation(frame.to_user((low + high) / 2), frame.scale * shrink)
