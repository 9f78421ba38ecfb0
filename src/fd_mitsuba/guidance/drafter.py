"""Pictures of the edited object that the model draws at once, and the way towards them: how a part is drafted.

A model that sees the base beside the noise, and whose latents are normals and coverage, draws the edited object from
four sides in one picture. What it draws is sharper, and more surely what the prompt says, than what its single answers
at random noise levels add up to: a mean over all places where a thin part may be covers no pixel by half.

    g = d(z) / mean |d(base)|,   d(z) = sign(z - drawn) min(max(|z - drawn| - T, 0) / T, 1)

with T what a copy of the base is off by. At the base g is as large as a gradient of `DiffusionGuidance.guide` with
`normalise_gradient`, and the smaller the nearer the part comes to its draft. Not in the paper.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import Beside, Chunk
from fd_mitsuba.guidance.ddim import sample
from fd_mitsuba.guidance.interface import Drawn, GuidanceResult, GuidanceViews
from fd_mitsuba.guidance.mosaic import tile_views, untile_views
from fd_mitsuba.guidance.query import Distillation, Query, guidance_coefficients

if TYPE_CHECKING:
    from fd_mitsuba.guidance.diffusion import DiffusionGuidance

STEPS = 6
"""Of DDIM; with twice as many a judge of parts is as sure."""
TOLERANCE = 0.15
"""What a copy of the base is off by in some channel, see `prior.judging.evaluate.KEPT_WITHIN`."""


class DiffusionDrafter:
    """Draws with a guidance whose prompt is set, in the coarse phase.

    Args:
        guidance: with `conventions.is_packed` and `has_image_pass`.
    """

    def __init__(self, guidance: DiffusionGuidance) -> None:
        self._guidance = guidance

    @network_threads()
    @torch.no_grad()
    def draw(self, views: GuidanceViews, seed: int) -> Drawn:
        """What the model draws for views of the base, by DDIM from the seed's noise.

        Args:
            views: `base` is looked at; `pictures` are not.
        """
        guidance = self._guidance
        if views.base is None:
            raise ValueError("the base's pictures are what the model draws on")
        images = tile_views(views.base, guidance.view_grid).to(guidance.device)
        base = guidance.encode(images, "coarse")
        scales = guidance.conventions.draft_scale, guidance.config.image_guidance_scale
        how = Distillation(guidance.variant, guidance.config.weighting, *scales, timestep_range=(0.0, 1.0))
        passes = tuple(guidance_coefficients(how, has_image_pass=True))
        texts = guidance.embeddings(guidance.prompts(views), passes)
        noise = torch.randn(base.shape, generator=torch.Generator().manual_seed(seed)).to(guidance.device)
        none = torch.zeros(len(base), dtype=torch.int64, device=guidance.device)
        conditions = guidance.conditions
        beside = Beside(conditions.beside_latents(images, conditions.where(views), "coarse"))
        chunk = Chunk(base, noise, none, texts, beside, areas=guidance.texts.areas(views, passes))
        latents = sample(Query(guidance, chunk, how).guided, guidance.alpha_bars, noise, STEPS)
        return Drawn(latents.cpu(), self._part(base, latents).cpu(), float(_difference(base, latents).abs().mean()))

    def guide(self, pictures: Tensor, drawn: Drawn, chosen: slice) -> GuidanceResult:
        """The loss of one step, whose gradient is the mean over pictures (mosaics) of g summed over latents.

        Args:
            pictures: geometry pictures (B, 5, H, H) of the edited object, those that the base's were drawn on.
            drawn: of these views and others.
            chosen: which of the drawn latents these are.
        """
        guidance = self._guidance
        images = tile_views(pictures, guidance.view_grid).to(guidance.device)
        z, wanted = guidance.encode(images, "coarse"), drawn.latents[chosen].to(guidance.device)
        gradient = _difference(z.detach(), wanted) / drawn.change
        value = 0.5 * float(gradient.square().sum()) / len(z)
        logs = {
            "guidance_loss": value,
            "guidance_gradient_mean": float(gradient.abs().mean()),
            "guidance_gradient_max": float(gradient.abs().max()),
        }
        return GuidanceResult(sds.carry_gradient(z, gradient / len(z), value).cpu(), logs, wanted)

    def _part(self, base: Tensor, drawn: Tensor) -> Tensor:
        """(B, H, H): 0 where no channel differs by 2 T, 1 where one does by 4 T, and 0 where the base is worn away."""
        away = (drawn - base).abs().amax(dim=1, keepdim=True)
        surely = (away / (2 * TOLERANCE) - 1).clamp(0, 1) * (self._guidance.latents.coverage(drawn) > 0.5)
        return untile_views(surely, self._guidance.view_grid)[:, 0]


def _difference(z: Tensor, drawn: Tensor) -> Tensor:
    """d(z)."""
    away = z - drawn
    return away.sign() * ((away.abs() - TOLERANCE) / TOLERANCE).clamp(0, 1)
