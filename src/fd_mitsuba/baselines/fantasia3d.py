"""The method `fantasia3d`: one field for the whole object, which starts as the base and is guided as a whole.

Fantasia3D* of the paper ("Experimental Setups"): no frozen base, no union, no L_GF, no L_CA; every vertex may move.
Deviates: Fantasia3D fits its network to the base's signed distance in 15000 iterations; here, as in `fields.part_sdf`,
the base's distance stays as it is and the network learns what is added to it. So the fit is exact at the grid's
vertices and takes no time, and whatever is lost of the base is lost by the edit.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.baselines.guided_stage import GuidedStage
from fd_mitsuba.baselines.interface import BASELINES, EditedMesh, EditTask
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import Weight
from fd_mitsuba.errors import RunStopped
from fd_mitsuba.extraction.surface import FAR_OUTSIDE, SurfaceExtractor
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.guidance.interface import Phase
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.training.descent import adamw, descend, fade
from fd_mitsuba.training.geometry_stage import EXPLODED_BEYOND, GeometryStage
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.viewing.sheets import geometry_sheet


class Fantasia3dSettings(Section):
    """Of `fantasia3d`."""

    lambda_volume: Weight = 0.0
    """Weight of a penalty on the share of the grid that the object fills, as `geometry.lambda_volume`; not in the
    original."""


class WholeObjectStage(GuidedStage):
    """A stage whose field is the whole object; see `training.stage.Stage`.

    Args:
        own: our own method's stage of the same scene and settings, with its guidance: gives cameras, base, guidance.
        settings: the method's own.
    """

    def __init__(self, own: GeometryStage, settings: Fantasia3dSettings) -> None:
        super().__init__(own)
        self._settings = settings
        grid, count = own.grid, own.grid.count
        self.extractor = SurfaceExtractor(
            grid,
            torch.full((count,), FAR_OUTSIDE),
            own.sdf_base,
            GridVertices(torch.arange(count)),  # the extractor leaves the grid's border out
            union_k=0.0,
        )
        self.field = PartField(self.config.field, seed_for(self.config.seed, Purpose.FIELD))
        self.optimiser = adamw(self.field, self.config.geometry)
        self._passes: dict[Phase, GeometryPass] = {}

    def surface(self) -> UnionSurface:
        """The object's surface; gradients flow to the field."""
        return self.extractor(self.field)

    def step(self, step: int) -> StepRecord:
        """Run step `step` and change the field once; RunStopped if there is no surface left or no number."""
        phase, _, _ = self.own.phase_of(step)
        cameras, closeup = self.own.cameras(step)
        surface = self.extractor(self.field, self._samples(step))
        if not len(surface.faces):
            raise RunStopped(f"step {step}: the object vanished; lower guidance.guidance_scale")
        seed = seed_for(self.config.seed, Purpose.PIXELS, step)
        pictures = self._pass(phase).render(surface.vertices, surface.faces, surface.part_weight, cameras, seed)
        result = self.own.ask(pictures, cameras, closeup, step)
        losses: dict[str, Tensor] = {"sds": result.loss}
        weights = {"sds": self.config.geometry.lambda_sds}
        if self._settings.lambda_volume > 0:
            inside = (0.5 + surface.sample_sdf / (2 * self.own.grid.spacing)).clamp(0, 1)
            losses["volume"], weights["volume"] = inside.mean(), self._settings.lambda_volume
        remedy = "lower geometry.learning_rate or guidance.guidance_scale"
        fade(self.optimiser, self.config.geometry, step)
        values = result.logs | descend(self.optimiser, losses, weights, step, remedy)
        values["faces"] = float(len(surface.faces))
        return StepRecord(values, partial(geometry_sheet, pictures.detach(), result.preview))

    def check_field(self, step: int) -> dict[str, float]:
        """The object's volume over the base's; RunStopped for a field that exploded or is empty."""
        sdf = self.extractor.part_sdf(self.field)
        start = self.own.sdf_base[self.extractor.active_index]
        away = float((sdf - start).abs().max())
        if not np.isfinite(away) or away > EXPLODED_BEYOND:
            raise RunStopped(f"step {step}: the object's field exploded; lower geometry.learning_rate")
        inside = float((sdf > 0).sum()) / max(float((start > 0).sum()), 1.0)
        if inside == 0:
            raise RunStopped(f"step {step}: the object vanished; lower guidance.guidance_scale")
        return {"volume_ratio": inside}

    def _samples(self, step: int) -> GridVertices | None:
        if self._settings.lambda_volume == 0:
            return None
        active = self.extractor.active_index
        generator = torch.Generator().manual_seed(seed_for(self.config.seed, Purpose.SAMPLES, step))
        chosen = torch.randint(len(active), (self.config.geometry.focal_samples,), generator=generator)
        return GridVertices(active[chosen])

    def _pass(self, phase: Phase) -> GeometryPass:
        if phase not in self._passes:
            self._passes = {phase: self.own.new_pass(phase)}
        return self._passes[phase]


@BASELINES.register("fantasia3d", Fantasia3dSettings)
def fantasia3d(settings: Fantasia3dSettings, task: EditTask) -> EditedMesh:
    """Fantasia3D started from the base: one field for the whole object, guided as a whole; nothing is frozen."""
    stage = WholeObjectStage(task.own, settings)
    fit = fit_error(stage)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    with torch.no_grad():
        made = stage.surface()
    edited = EditedMesh(task.scene, (made.vertices, made.faces), {"fit_cells": fit})
    edited.guidance_calls = stage.steps
    return edited


@torch.no_grad()
def fit_error(stage: WholeObjectStage) -> float:
    """How far the stage's present surface is from the base's at most, in cells of the grid.

    Measured from the surface's vertices to the base: small pieces of the base that fall through the grid do not count.
    """
    return surface_error(stage.own, stage.surface().vertices)


def surface_error(own: GeometryStage, vertices: Tensor) -> float:
    """How far vertices (V, 3) are from the base's surface at most, in cells of the grid."""
    base = own.scene.base_canonical
    return float(MeshDistance(base.vertices, base.faces).unsigned(vertices.numpy()).max()) / own.grid.spacing
