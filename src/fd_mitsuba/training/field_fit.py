"""A field that is brought to a given shape before anything guides it."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.fields.part_sdf import PartField

STEPS, LEARNING_RATE = 80, 5e-3
_POINTS = 2048
_BAND_CELLS = 4.0


def fit_field(
    field: PartField, points: Tensor, initial_sdf: Tensor, target: Tensor, spacing: float, seed: int
) -> float:
    """Change the field until its sdf is about `target`; returns the mean error of the last step, in cells.

    The absolute error, at random points, half of them near the target's surface. What is further than four cells from
    the surface on both sides counts as right: how far it is does not matter.

    Args:
        points: (N, 3) canonical; initial_sdf: (N,) there, see `PartField.evaluate`.
        target: (N,) signed distance, inside positive, canonical units.
        spacing: side of a cell.
        seed: decides the points.
    """
    band = _BAND_CELLS * spacing
    target = target.clamp(-band, band)
    near = torch.nonzero(target.abs() < band).flatten()
    if not len(near):
        raise ValueError("the target has no surface among the points")
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(field.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.99))
    error = torch.tensor(0.0)
    for step in range(STEPS):
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1 - step / STEPS)
        anywhere = torch.randint(len(points), (_POINTS,), generator=generator)
        chosen = torch.cat([anywhere, near[torch.randint(len(near), (_POINTS,), generator=generator)]])
        wanted, found = target[chosen], field.evaluate(points[chosen], initial_sdf[chosen]).sdf
        right = (found.abs() > band) & (found.sign() == wanted.sign())
        error = torch.where(right, 0.0, found - wanted).abs().mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
    optimiser.zero_grad()
    return float(error.detach()) / spacing
