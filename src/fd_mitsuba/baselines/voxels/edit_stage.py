"""The edit of Vox-E-Global: score distillation on volume renderings, held to the base by a volumetric correlation.

    L = lambda_sds L_SDS + lambda_correlation (1 - corr(density, density_base))
    corr(a, b) = cov(a, b) / sqrt(var(a) var(b))

over the raw densities of all voxels (Vox-E, arXiv 2303.12048).
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from fd_mitsuba.baselines.guided_stage import GuidedStage
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.rendering import render_normals
from fd_mitsuba.errors import RunStopped
from fd_mitsuba.training.descent import descend
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.viewing.sheets import geometry_sheet

_DECAY, _DECAY_EVERY, _DECAY_FROM = 0.96, 1 / 20, 5 / 8
"""Vox-E's 0.96 every 400 of 8000 steps from the 5000th on, as shares of the steps."""


def loss_correlation(density: Tensor, base: Tensor) -> Tensor:
    """1 - the correlation of two grids' values, any equal shapes: 0 where one is the other times a positive factor
    plus a constant, 2 at most. Gradients flow."""
    one, other = density - density.mean(), base - base.mean()
    return 1 - (one * other).mean() / (one.square().mean() * other.square().mean()).sqrt().clamp(min=1e-12)


class VoxelEditStage(GuidedStage):
    """A stage whose field is a voxel grid; see `training.stage.Stage`.

    Args:
        own: our own method's stage of the same scene and settings, with its guidance: gives cameras, base, guidance.
        base: the fitted grid, which stays as it is.
        samples: pieces of a ray.
        learning_rate: of Adam, for raw densities and features.
        lambda_correlation: weight of `loss_correlation`.
    """

    def __init__(
        self, own: GeometryStage, base: VoxelGrid, samples: int, learning_rate: float, lambda_correlation: float
    ) -> None:
        super().__init__(own)
        self._samples, self._learning_rate, self._lambda = samples, learning_rate, lambda_correlation
        self._base = base.density.detach().clone()
        self.field = VoxelGrid(base.resolution, len(base.features), base.half_extent)
        self.field.load_state_dict(base.state_dict())
        self.optimiser = torch.optim.Adam(self.field.parameters(), lr=learning_rate, eps=1e-15)

    def step(self, step: int) -> StepRecord:
        """Run step `step` and change the grid once; RunStopped if a number is not finite."""
        phase, _, _ = self.own.phase_of(step)
        cameras, closeup = self.own.cameras(step)
        guidance = self.own.guidance
        assert guidance is not None
        generator = torch.Generator().manual_seed(seed_for(self.config.seed, Purpose.PIXELS, step))
        space = self.config.geometry.normal_space
        normal, mask = render_normals(
            self.field, cameras, guidance.picture_size(phase), self._samples, generator, space
        )
        pictures = torch.cat([normal, mask, mask], dim=1)
        result = self.own.ask(pictures, cameras, closeup, step)
        losses = {"sds": result.loss, "correlation": loss_correlation(self.field.density, self._base)}
        weights = {"sds": self.config.geometry.lambda_sds, "correlation": self._lambda}
        late = max(step / self.steps - _DECAY_FROM, 0.0)
        for group in self.optimiser.param_groups:
            group["lr"] = self._learning_rate * _DECAY ** int(late / _DECAY_EVERY)
        remedy = "lower the method's learning_rate or guidance.guidance_scale"
        values = result.logs | descend(self.optimiser, losses, weights, step, remedy)
        return StepRecord(values, partial(geometry_sheet, pictures.detach(), result.preview))

    def check_field(self, step: int) -> dict[str, float]:
        """The share of voxels that are solid over the base's; RunStopped where a value is not finite or none is."""
        if not all(bool(torch.isfinite(values).all()) for values in self.field.parameters()):
            raise RunStopped(f"step {step}: the voxel grid is not finite; lower the method's learning_rate")
        solid, before = (float((values > 0).sum()) for values in (self.field.density, self._base))
        if solid == 0:
            raise RunStopped(f"step {step}: the voxel grid is empty; lower the method's learning_rate")
        return {"volume_ratio": solid / max(before, 1.0)}
