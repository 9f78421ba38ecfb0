"""What a part's field adds to its regions, as a spline through the vertices of the training's lattice.

The training never asks the field anywhere else. Between them a field on a hash grid has a kink wherever it passes from
one cell of its own to the next: on a mirror each of them is a torn reflection. The spline passes through all that was
trained, and has none.
"""

from __future__ import annotations

import numpy as np
import torch

from fd_mitsuba.export.final_surface.spline import LatticeSpline
from fd_mitsuba.extraction.grown_part import GrownPart
from fd_mitsuba.scene.focal_region import union_sdf

_BEYOND = 3
"""So many vertices around those at which the part exists are asked for, too: a spline sees two."""


@torch.no_grad()
def learned_spline(grown: GrownPart) -> LatticeSpline:
    """`sdf_part` less the distance to the focal regions, canonical units."""
    grid = grown.grid
    index = grown.extractor.active_index.numpy()
    places = np.stack(np.unravel_index(index, (grid.side,) * 3), axis=1)  # z, y, x
    low, high = np.zeros(3, dtype=np.int64), np.full(3, grid.side)
    if len(index):
        low = np.maximum(places.min(axis=0) - _BEYOND, 0)
        high = np.minimum(places.max(axis=0) + 1 + _BEYOND, grid.side)
    axes = [grid.axis[int(a) : int(b)] for a, b in zip(low, high, strict=True)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    points = torch.stack([x, y, z], dim=-1).reshape(-1, 3).float()
    regions = [region for own in grown.parts.values() for region in own]
    region = torch.from_numpy(union_sdf(regions, points.double().numpy())).float()
    learned = grown.field.evaluate(points, region).sdf - region
    return LatticeSpline.through(
        learned.view(z.shape).numpy(), np.array([float(axis[0]) for axis in axes[::-1]]), grid.spacing
    )
