"""One step of the geometry stage: field -> surface -> pictures -> guidance and losses -> optimiser.

L_geo = lambda_sds L_SDS + lambda_focal L_GF + lambda_collision L_CA (paper, supplement "Geometry Learning"), and an
optional price on the part's volume, on empty regions and on loose pieces. A weight of 0 turns its work off.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.backend.threads import step_threads
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import RunStopped, UserError
from fd_mitsuba.extraction.active_vertices import active_vertices
from fd_mitsuba.extraction.grown_part import GrownPart
from fd_mitsuba.extraction.subtraction import SubtractionExtractor
from fd_mitsuba.extraction.surface import SurfaceExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.base_shape import base_sdf
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.fields.varied_start import start_of_regions
from fd_mitsuba.guidance.interface import Guidance, GuidanceResult, GuidanceViews, Phase
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.framing import bounding_ball, centre_of_box
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.descent import adamw, descend, fade
from fd_mitsuba.training.draft import Draft, Drafts, Place
from fd_mitsuba.training.field_losses import FieldLosses, asked_depth
from fd_mitsuba.training.region_masks import RegionMasks
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.training.step_views import check_views, step_views
from fd_mitsuba.training.visibility import INVISIBLE, watch_visibility
from fd_mitsuba.training.weight_average import WeightAverage
from fd_mitsuba.viewing.sheets import geometry_sheet

EXPLODED_BEYOND = 1.0
"""A signed distance further than this from where it started, canonical units, is no shape any more."""


class GeometryStage:
    """Everything that the geometry stage holds between steps; its random numbers depend on (seed, step) only.

    Args:
        scene: what to edit.
        config: how.
        guidance: the source of the image loss; its prompt must be set. None leaves the image loss out.
    """

    name = "geometry"

    def __init__(self, scene: EditScene, config: RunConfig, guidance: Guidance | None) -> None:
        geometry = config.geometry
        trained_in = guidance.normal_space if guidance is not None else None
        if trained_in not in (None, geometry.normal_space):
            raise UserError(
                f"geometry.normal_space = {geometry.normal_space!r}: {config.guidance.source} was trained with normals "
                f"in {trained_in} space; set geometry.normal_space={trained_in}"
            )
        check_views(self.name, config, guidance)
        self.scene, self.config, self.guidance = scene, config, guidance
        self.grid = TetGrid(geometry.grid_resolution)
        points = self.grid.vertices.numpy()
        base = scene.base_canonical
        self.sdf_base = torch.from_numpy(base_sdf(points, base.vertices, base.faces))
        regions = torch.from_numpy(np.stack([region.sdf(points) for region in scene.regions]))
        self.region_sdf = regions.amax(dim=0)
        if not bool((self.region_sdf > 0).any()):
            raise UserError(
                f"{scene.path}: no vertex of the grid lies within a focal region; thicken them, or raise "
                f"geometry.grid_resolution={geometry.grid_resolution}"
            )
        self.start_sdf = start_of_regions(regions, points, self._variety(), seed_for(config.seed, Purpose.START))
        self.active = active_vertices(self.grid, self.region_sdf)
        self.extractor = self._extractor(self.active)
        self.field_losses = FieldLosses(
            config, self.grid, self.sdf_base, regions, self.extractor.active_index, scene.subtracts
        )
        self.base_surface = self._base_surface()
        self.field = PartField(config.field, seed_for(config.seed, Purpose.FIELD))
        self.optimiser = adamw(self.field, geometry)
        self.average = WeightAverage(self.field, geometry.average) if geometry.average > 0 else None
        own = [regions[[region.part == name for region in scene.regions]].amax(dim=0) for name in scene.parts]
        own = [sdf for sdf in own if bool((sdf > 0).any())]
        self.foci = [bounding_ball(points[(sdf > 0).numpy()]) for sdf in own]
        self.aim = centre_of_box(np.concatenate([base.vertices, points[(self.region_sdf > 0).numpy()]]))
        self._passes: dict[Phase, GeometryPass] = {}
        self._base_passes: dict[Phase, GeometryPass] = {}
        self._region_masks = RegionMasks(scene, config, guidance)
        places = [Place(base, self.extractor, sdf, focus) for sdf, focus in zip(own, self.foci, strict=True)]
        planned = Drafts.planned(config, guidance, self.coarse_steps, places, self._views_of_base)
        self.drafts = None if scene.subtracts else planned
        self.counters = {INVISIBLE: 0}
        """Whole numbers that steps hand on to later ones; a checkpoint keeps them."""

    @property
    def steps(self) -> int:
        """Steps of both phases together."""
        return self.config.geometry.steps

    @property
    def coarse_steps(self) -> int:
        """How many steps the coarse phase has."""
        return round(self.config.geometry.steps * self.config.geometry.coarse_fraction)

    def phase_of(self, step: int) -> tuple[Phase, int, int]:
        """The phase of a step, its place in the phase, and the phase's length."""
        coarse = self.coarse_steps
        if step < coarse:
            return "coarse", step, coarse
        return "refined", step - coarse, self.config.geometry.steps - coarse

    def phase_name(self, step: int) -> str:
        """`coarse` or `refined`."""
        return self.phase_of(step)[0]

    def cameras(self, step: int) -> tuple[CameraBatch, bool]:
        """The step's views, and whether they are close-ups of a part's focal regions, of each in turn."""
        if (draft := self._draft(step)) is not None:
            return draft.cameras, True
        seed = seed_for(self.config.seed, Purpose.VIEWS, step)
        count = self.config.geometry.views
        return step_views(self.config.cameras, count, seed, self.foci[step % len(self.foci)], self.aim, self.guidance)

    @property
    def final_field(self) -> PartField:
        """The field that is exported: the average where there is one, without gradients, else the learned one."""
        return self.field if self.average is None else self.average.module

    def surface(self) -> UnionSurface:
        """The surface of the base with the part, or without it, for `final_field` as it is."""
        return self.extractor(self.final_field)

    def start_surface(self) -> UnionSurface:
        """`surface` with what the part starts as, the focal regions or a variation of them, without gradients."""
        with torch.no_grad():
            return self.extractor(PartField(self.config.field.model_copy(update={"offsets": False})))

    def grown(self) -> GrownPart:
        """What exports need of the stage. It follows the field: later steps change it."""
        return GrownPart(self.scene.parts, self.scene.base_canonical, self.extractor, self.final_field)

    def step(self, step: int) -> StepRecord:
        """Run step `step` (counted from 0 over both phases) and change the field once.

        Raises:
            RunStopped: a value that is not finite, a field that explodes, a part that stays invisible.
        """
        with step_threads(self._samples(self.phase_of(step)[0])):
            return self._step(step)

    def _samples(self, phase: Phase) -> int:
        """How many a step renders in this process."""
        if self.guidance is None or self.config.geometry.lambda_sds == 0:
            return 0
        views, rendered = self.config.geometry.views // processes().count, self._pass(self._passes, phase)
        return views * rendered.size**2 * (rendered.spp + rendered.silhouette_spp)

    def _step(self, step: int) -> StepRecord:
        geometry = self.config.geometry
        phase = self.phase_of(step)[0]
        cameras, closeup = self.cameras(step)
        if self.drafts is not None and step == 0:
            self.drafts.begin(self.field)
        asked = self.field_losses.ask(step)
        surface = self.extractor(self.field, asked.samples if asked is not None else None)
        losses: dict[str, Tensor] = {}
        values: dict[str, float] = {}
        pictures, preview = torch.zeros(0), None
        if self.guidance is not None and geometry.lambda_sds > 0:
            share = processes().share(len(cameras))
            cameras = cameras.some(share)
            pictures = self._render(surface, cameras, phase, step, share.start)
            result = self.ask(pictures, cameras, closeup, step, share)
            losses["sds"], preview = result.loss, result.preview
            values.update(processes().values_of_all(result.logs))
            watch_visibility(pictures, self.counters, self.scene.subtracts)
        if asked is not None:
            losses.update(self.field_losses(surface.sample_sdf, asked, step))
        weights = {"sds": geometry.lambda_sds, **self.field_losses.weights}
        remedy = "lower geometry.learning_rate or guidance.guidance_scale"
        fade(self.optimiser, geometry, step)
        values.update(descend(self.optimiser, losses, weights, step, remedy))
        if self.average is not None:
            self.average.update(self.field, step)
        values["part_faces"] = float(surface.face_is_part.sum())
        return StepRecord(values, partial(geometry_sheet, pictures.detach(), preview))

    def ask(
        self, pictures: Tensor, cameras: CameraBatch, closeup: bool, step: int, share: slice | None = None
    ) -> GuidanceResult:
        """What the guidance says of pictures (B, 5, H, H) of a step's views; gradients flow to them.

        The pictures may be those of another representation of the scene, rendered from `self.cameras(step)` at the
        size that the guidance wants: it is then guided as this stage is, with the same base, noise and timesteps.

        Args:
            share: which of the step's views these are, where several processes share them; None: they are all.
        """
        assert self.guidance is not None
        phase, phase_step, phase_length = self.phase_of(step)
        first = 0 if share is None else share.start
        if (draft := self._draft(step)) is not None:
            return draft.guide(pictures, first)
        base = self._render_base(cameras, phase, step, first) if self.guidance.needs_base else None
        regions = self._region_masks(cameras, step, first)
        angles = cameras.azimuth_deg, cameras.elevation_deg
        drafted = self.drafts is not None and self.drafts.lead
        views = GuidanceViews(pictures, base, *angles, closeup, regions, share, drafted)
        seed = seed_for(self.config.seed, Purpose.GUIDANCE, step)
        return self.guidance.guide(views, phase_step, phase_length, phase, seed)

    def new_pass(self, phase: Phase) -> GeometryPass:
        """A render of the size and the samples that pictures of a phase have."""
        geometry = self.config.geometry
        size = self.guidance.picture_size(phase) if self.guidance is not None else 64
        # A picture of the refined phase is averaged down by the encoder: one sample a pixel is plenty.
        spp = geometry.spp if phase == "coarse" else 1
        return GeometryPass(size, spp, geometry.silhouette_spp, geometry.normal_space)

    def check_field(self, step: int) -> dict[str, float]:
        """The part's volume over the focal regions'; RunStopped for a field not finite, exploded, or empty for good."""
        sdf = self.extractor.part_sdf(self.field)
        start = self.region_sdf[self.extractor.active_index]
        if not torch.isfinite(sdf).all():
            raise RunStopped(f"step {step}: the part's field is not finite; lower geometry.learning_rate")
        away = float((sdf - start).abs().max())
        if away > EXPLODED_BEYOND:
            raise RunStopped(
                f"step {step}: the part's field exploded (it is {away:.2f} away from its start); "
                "lower geometry.learning_rate or geometry.lambda_sds"
            )
        inside = float((sdf > 0).sum()) / max(float((start > 0).sum()), 1.0)
        # What the presence loss brings back may be thinner than a cell for a while; `watch_visibility` waits for it.
        may_return = self.config.geometry.lambda_presence > 0 and step < self.steps
        if inside == 0.0 and not may_return:
            raise RunStopped(
                f"step {step}: the part vanished; raise geometry.lambda_presence, or lower geometry.lambda_volume or "
                "guidance.guidance_scale"
            )
        return {"volume_ratio": inside}

    def _render(self, surface: UnionSurface, cameras: CameraBatch, phase: Phase, step: int, first: int) -> Tensor:
        return self._pass(self._passes, phase).render(
            surface.vertices,
            surface.faces,
            surface.part_weight,
            cameras,
            seed_for(self.config.seed, Purpose.PIXELS, step) + first,
            static_faces=self.extractor.static_faces,
            static_vertices=self.extractor.static_vertices,
        )

    def _render_base(self, cameras: CameraBatch, phase: Phase, step: int, first: int) -> Tensor:
        base = self.base_surface
        return self._pass(self._base_passes, phase).render_primal(
            base.vertices,
            base.faces,
            base.part_weight,
            cameras,
            seed_for(self.config.seed, Purpose.BASE_PIXELS, step) + first,
            static_faces=len(base.faces),
        )

    def _views_of_base(self, cameras: CameraBatch) -> GuidanceViews:
        base, regions = self._render_base(cameras, "coarse", 0, 0), self._region_masks(cameras, 0, 0)
        return GuidanceViews(base, base, cameras.azimuth_deg, cameras.elevation_deg, True, regions)

    def _pass(self, passes: dict[Phase, GeometryPass], phase: Phase) -> GeometryPass:
        if phase not in passes:
            passes.clear()
            passes[phase] = self.new_pass(phase)
        return passes[phase]

    def _extractor(self, active: GridVertices) -> SurfaceExtractor:
        geometry = self.config.geometry
        kind = SubtractionExtractor if self.scene.subtracts else SurfaceExtractor
        return kind(
            self.grid, self.sdf_base, self.start_sdf, active, geometry.union_k, geometry.union_only_outside,
            depth=asked_depth(geometry, self.grid, self.scene.subtracts),
        )  # fmt: skip

    def _draft(self, step: int) -> Draft | None:
        """That which the step follows; None: it is guided."""
        return None if self.drafts is None else self.drafts.of(step)

    def _variety(self) -> float:
        """0 for seed 0, which starts from the regions themselves, and where nothing guides and a start would stay."""
        varies = self.config.seed != 0 and self.config.geometry.lambda_sds > 0 and not self.scene.subtracts
        return self.config.geometry.start_variety if varies else 0.0

    def _base_surface(self) -> UnionSurface:
        with torch.no_grad():
            alone = self._extractor(GridVertices(torch.zeros(0, dtype=torch.int64)))
            return alone(PartField(self.config.field))
