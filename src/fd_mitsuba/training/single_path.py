"""The paper's ablation without two paths: one field for the whole object, which first learns the base's material."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.surface_points import chosen_rows


def learn_base_material(
    field: TextureField, base: BaseAppearance, points: Tensor, learning_rate: float, steps: int, run_seed: int
) -> None:
    """Fit a field to what the base looks like at points (N, 3) of its surface: where the single path starts from."""
    material = base.lookup(points)
    optimiser = torch.optim.AdamW(field.parameters(), lr=learning_rate)
    for step in range(steps):
        rows = chosen_rows(len(points), 4096, seed_for(run_seed, Purpose.BASE_MATERIAL, step))
        wrong = torch.where(material.known[rows], field(points[rows]).style() - material.style()[rows], 0.0)
        optimiser.zero_grad(set_to_none=True)
        wrong.square().mean().backward()
        optimiser.step()
