"""Style consistency of a run: the points that its losses compare, and what the base looks like beside them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fd_mitsuba.config import AppearanceConfig
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.losses.style import jittered, loss_style_boundary, loss_style_gradient
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.surface_points import chosen_rows


class StyleConsistency:
    """L_g and L_b on a pool of surface points; paper, "Style Consistency".

    Args:
        base: looks the base's material up.
        points: (N, 3) canonical, uniform on the parts' surface.
        settings: how many points a step, how far the boundary reaches.
        run_seed: which points a step takes follows from it and the step.
        say: takes a remark if the parts have no boundary.

    Attributes:
        boundary: (M, 3) the points within reach of the base; M may be 0.
        beside: the base's material at the nearest point of its surface.
    """

    def __init__(
        self,
        base: BaseAppearance,
        points: Tensor,
        settings: AppearanceConfig,
        run_seed: int,
        say: Callable[[str], None],
    ) -> None:
        self._points, self._settings, self._run_seed = points, settings, run_seed
        self.boundary = points[base.distance(points) < settings.boundary_reach]
        self.beside = base.lookup(self.boundary)
        if not len(self.boundary):
            say(
                f"style consistency: no point of the part is within {settings.boundary_reach} of the base, so nothing "
                "ties its colours to the base; raise appearance.boundary_reach"
            )

    def losses(self, field: TextureField, step: int) -> dict[str, Tensor]:
        """`style_gradient`, and `style_boundary` where there is a boundary; gradients flow to the field."""
        settings, seed = self._settings, seed_for(self._run_seed, Purpose.STYLE, step)
        points = self._points[chosen_rows(len(self._points), settings.style_samples, seed)]
        jitter_seed = seed_for(self._run_seed, Purpose.STYLE_JITTER, step)
        moved = jittered(points, settings.style_jitter, torch.Generator().manual_seed(jitter_seed))
        losses = {"style_gradient": loss_style_gradient(field(points).style(), field(moved).style())}
        if len(self.boundary):
            rows = chosen_rows(len(self.boundary), settings.style_samples, seed)
            part = field(self.boundary[rows]).style()
            # Where the base's BSDF says nothing, nothing is asked of the part.
            base = torch.where(self.beside.known[rows], self.beside.style()[rows], part.detach())
            losses["style_boundary"] = loss_style_boundary(part, base)
        return losses


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
