"""One step of the appearance stage: texture field -> lit pictures -> guidance and style losses -> optimiser.

L_app = lambda_sds L_SDS + lambda_style (L_g + lambda_boundary L_b) + lambda_bend L_bend  (paper, "Appearance Editing"
and supplement "Appearance Learning", which have no L_bend). The base has no parameter here: what it looks like comes
from the scene file alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.backend.threads import step_threads
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import RunStopped
from fd_mitsuba.fields.texture import TextureField, TextureValues
from fd_mitsuba.fields.textures_apart import TexturesApart
from fd_mitsuba.guidance.colour_latents import shine
from fd_mitsuba.guidance.device import field_device
from fd_mitsuba.guidance.interface import AppearanceGuidance, AppearanceViews
from fd_mitsuba.render.appearance_pass import AppearancePass, AppearancePictures
from fd_mitsuba.render.appearance_scene import Triangles
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.render.part_shading import PartShading
from fd_mitsuba.render.surface_views import surface_views
from fd_mitsuba.render.tonemap import CLAY_LEVEL, auto_exposure, to_linear, to_srgb
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.framing import bounding_ball, centre_of_box
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.appearance_losses import AppearanceLosses, PartSurface
from fd_mitsuba.training.descent import adamw, descend, fade
from fd_mitsuba.training.region_masks import RegionMasks, one_by_one, shown_first, shown_parts
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.single_path import learn_base_material
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.training.step_views import check_views, step_views
from fd_mitsuba.training.surface_points import points_on
from fd_mitsuba.training.weight_average import WeightAverage
from fd_mitsuba.viewing.sheets import appearance_sheet

_POOL = 32768
"""Points on the parts' surface that the style losses choose from."""
_INITIAL_STEPS = 300
"""Steps in which the single path's field learns the base's own material before the guidance starts."""


class AppearanceStage:
    """Everything that the appearance stage holds between steps; its random numbers depend on (seed, step) only.

    Args:
        scene: what to edit; its emitters light it.
        config: how.
        parts: name -> closed mesh of the part, canonical frame, as the geometry stage left it; where parts are cut out,
            the faces of the cut.
        guidance: the source of the image loss; its prompt must be set. None leaves the image loss out.
        say: takes remarks for the user, a line each.
        opened: the base after a cut; see `AppearanceScene.build`.

    Raises:
        UserError: no light, a part material without anything to learn, views that do not fill the model's mosaic.
    """

    name = "appearance"

    def __init__(
        self,
        scene: EditScene,
        config: RunConfig,
        parts: Mapping[str, Triangles],
        guidance: AppearanceGuidance | None,
        say: Callable[[str], None] = print,
        opened: Mapping[int, Path | None] | None = None,
    ) -> None:
        settings = config.appearance
        check_views(self.name, config, guidance)
        self.scene, self.config, self.parts, self.guidance = scene, config, dict(parts), guidance
        self.steps = settings.steps
        self.counters: dict[str, int] = {}
        self.material = part_material(scene, settings.fixed, settings.normal_map)
        say(self.material.message)
        seed = seed_for(config.seed, Purpose.TEXTURE)
        self.field = self._new_field(seed)
        if guidance is not None:
            self.field.to(field_device(config.guidance))
        self.optimiser = adamw(self.field, settings)
        self.average: WeightAverage | None = None
        size = settings.picture_size or (guidance.appearance_size if guidance is not None else 128)
        self.shading = PartShading.of(self.material)
        self.rendering = AppearancePass(
            scene, self.parts, self.shading, size, settings.spp, settings.max_depth, settings.single_path, opened
        )
        corners = np.concatenate([np.asarray(mesh.vertices) for mesh in self.parts.values()])
        self.foci = [bounding_ball(np.asarray(mesh.vertices)) for mesh in self.parts.values()]
        self.aim = centre_of_box(np.concatenate([scene.base_canonical.vertices, corners]))
        self.exposure = settings.exposure or self._exposure()
        self._points = points_on(self.parts.values(), _POOL, seed_for(config.seed, Purpose.STYLE))
        self.losses = self._losses(say)
        self._region_masks = RegionMasks(scene, config, guidance)

    def phase_name(self, step: int) -> str:
        """The name that the progress line shows."""
        return self.name

    def cameras(self, step: int) -> tuple[CameraBatch, bool]:
        """The step's views, and whether they are close-ups of a part, of each in turn."""
        seed = seed_for(self.config.seed, Purpose.APPEARANCE_VIEWS, step)
        count = self.config.appearance.views
        return step_views(self.config.cameras, count, seed, self.foci[step % len(self.foci)], self.aim, self.guidance)

    def texture(self, gbuffer: GBuffer) -> TextureValues:
        """What the field says at the points that are seen, with gradients."""
        return self.field(gbuffer.points)

    def render(self, gbuffer: GBuffer, texture: TextureValues, seed: int) -> AppearancePictures:
        """The lit pictures of a traced view for given field values."""
        fed = {name: getattr(texture, name) for name in ("base_color", "roughness", "metallic")}
        normal = texture.normal if "normal" in self.material.learned else None
        return self.rendering.render(gbuffer, **fed, normal=normal, seed=seed)

    def step(self, step: int) -> StepRecord:
        """Run step `step` (counted from 0) and change the field once.

        Raises:
            RunStopped: a value that is not finite.
        """
        views = self.config.appearance.views // processes().count
        with step_threads(views * self.rendering.size**2 * self.rendering.spp):
            return self._step(step)

    def _step(self, step: int) -> StepRecord:
        settings = self.config.appearance
        cameras, closeup = self.cameras(step)
        share = processes().share(len(cameras))
        cameras = cameras.some(share)
        seed = seed_for(self.config.seed, Purpose.APPEARANCE_PIXELS, step) + share.start
        gbuffer = self.rendering.trace(cameras, seed)
        texture = self.texture(gbuffer)
        losses: dict[str, Tensor] = {}
        values: dict[str, float] = {"part_pixels": float(len(gbuffer.points))}
        preview = None
        pictures = self.render(gbuffer, texture, seed)
        if self.guidance is not None and settings.lambda_sds > 0:
            views = AppearanceViews(
                pictures=self._finished(pictures.merged, gbuffer, step),
                condition=self._condition(gbuffer, pictures, seed, step),
                mask=gbuffer.alpha,
                part_mask=gbuffer.part_mask,
                shine=self._shine(gbuffer, texture),
                azimuth_deg=cameras.azimuth_deg,
                elevation_deg=cameras.elevation_deg,
                closeup=closeup,
                regions=shown_first(self._region_masks(cameras, step, share.start), gbuffer),
                share=share,
                control=self._control(gbuffer),
            )
            guidance_seed = seed_for(self.config.seed, Purpose.APPEARANCE_GUIDANCE, step)
            asked = self._apart(views, gbuffer)
            results = [self.guidance.guide_appearance(one, step, settings.steps, guidance_seed) for one in asked]
            losses["sds"] = torch.stack([result.loss for result in results]).sum()
            preview = results[step % len(results)].preview
            values.update({name: float(np.mean([result.logs[name] for result in results])) for name in results[0].logs})
        values = processes().values_of_all(values)
        losses.update(self.losses(texture, gbuffer, self.field, step))
        weights = {"sds": settings.lambda_sds, **self.losses.weights}
        fade(self.optimiser, settings, step)
        values.update(descend(self.optimiser, losses, weights, step, "lower appearance.learning_rate"))
        shown = _detached(pictures), _without_gradient(texture)
        return StepRecord(values, partial(appearance_sheet, gbuffer, *shown, self.exposure, preview))

    def check_field(self, step: int) -> dict[str, float]:
        """The parts' mean base colour, roughness and metallic; raises RunStopped for a field that is not finite."""
        with torch.no_grad():
            texture = self.field(self._points[:1024])
        means = torch.cat([texture.base_color, texture.roughness, texture.metallic], 1).mean(0)
        if not torch.isfinite(means).all():
            raise RunStopped(f"step {step}: the texture field is not finite; lower appearance.learning_rate")
        names = ("mean_red", "mean_green", "mean_blue", "mean_roughness", "mean_metallic")
        return dict(zip(names, means.tolist(), strict=True))

    @torch.no_grad()
    def set_bounces(self) -> None:
        """Tell the light that bounces what the parts look like now; of no use where max_depth is 2."""
        for name, mesh in self.parts.items():
            texture = self.field(torch.from_numpy(np.asarray(mesh.vertices, np.float32)))
            values = {channel: getattr(texture, channel).numpy() for channel in self.material.feeds}
            self.rendering.set_vertex_values(name, values)

    def _finished(self, linear: Tensor, gbuffer: GBuffer, step: int) -> Tensor:
        """sRGB in [0, 1] over the configured background."""
        return to_srgb((linear + (1 - gbuffer.alpha) * self._background(gbuffer, step)) * self.exposure)

    def _shine(self, gbuffer: GBuffer, texture: TextureValues) -> Tensor:
        """(B, 1, S, S) of what the field says; constant where the BSDF has only one of roughness and metallic."""
        values = shine(texture.roughness, texture.metallic)[:, 0]
        if not {"roughness", "metallic"} <= set(self.material.learned):
            values = values.detach()
        film = torch.zeros(gbuffer.part_mask.numel()).index_copy(0, gbuffer.pixel, values.float())
        return film.view_as(gbuffer.part_mask) * gbuffer.part_mask

    def _background(self, gbuffer: GBuffer, step: int) -> Tensor:
        """Radiance behind the object, such that the exposure makes of it what the setting says."""
        kind = self.config.appearance.background
        if kind == "light":
            return self.rendering.render_light(gbuffer)
        if kind == "random":
            generator = torch.Generator().manual_seed(seed_for(self.config.seed, Purpose.BACKGROUND, step))
            count = self.config.appearance.views
            colours = torch.rand(count, 3, 1, 1, generator=generator)[processes().share(count)]
            colour = to_linear(colours)
        else:
            colour = torch.full((1, 3, 1, 1), 0.0 if kind == "black" else 1.0)
        return colour / self.exposure

    def _control(self, gbuffer: GBuffer) -> Tensor | None:
        """What the guidance's ControlNet, if it has one, is shown of the surface."""
        kind = getattr(self.guidance, "control_sees", None)
        return None if kind is None else surface_views(gbuffer, kind)

    def _new_field(self, seed: int) -> TextureField | TexturesApart:
        """One for all that grew, or one for each part where all have prompts of their own."""
        texture, start = self.config.texture, self.material
        if not self._parts_are_told_apart:
            return TextureField(texture, seed, start.start, start.learned)
        fields = [TextureField(texture, seed, start.start, start.learned) for _ in self.parts]
        return TexturesApart(fields, [self.scene.parts[name] for name in self.parts])

    @property
    def _parts_are_told_apart(self) -> bool:
        all_grew = self.parts.keys() == self.scene.parts.keys()
        told_apart = len(self.parts) > 1 and self.scene.told_apart and all_grew
        return told_apart and not self.config.appearance.single_path

    def _apart(self, views: AppearanceViews, gbuffer: GBuffer) -> list[AppearanceViews]:
        """What the guidance is asked in a step: of each part where all have texts of their own and it can be shown one.

        Without `mask_guidance` an answer about one part would move the others, too.
        """
        masked = self.config.appearance.mask_guidance and views.condition is not None
        if not masked or not self._parts_are_told_apart:
            return [views]
        return one_by_one(views, dict(zip(self.parts, shown_parts(gbuffer, len(self.parts)), strict=True)))

    @torch.no_grad()
    def _condition(self, gbuffer: GBuffer, pictures: AppearancePictures, seed: int, step: int) -> Tensor | None:
        """The same views with the part in plain grey clay, for models that are shown what they edit."""
        if self.guidance is None or not self.guidance.needs_base:
            return None
        clay_part = self.rendering.render_clay(gbuffer, seed)
        return self._finished(clay_part + pictures.base_path, gbuffer, step)

    def _losses(self, say: Callable[[str], None]) -> AppearanceLosses:
        settings, seed = self.config.appearance, self.config.seed
        surface = PartSurface(self.scene, self._points, self.material.learned, seed, say)
        if settings.single_path and isinstance(self.field, TextureField):
            points = points_on([self.scene.base_canonical], _POOL, seed_for(seed, Purpose.BASE_MATERIAL))
            learn_base_material(self.field, surface.base, points, settings.learning_rate, _INITIAL_STEPS, seed)
        return AppearanceLosses(self.config, surface)

    def _exposure(self) -> float:
        """By the light alone: the base in clay under it, so that a dark base does not make a white part glare."""
        cameras = CameraBatch.around(np.arange(4) * 90.0 + 20.0, 20.0, 3.4, 45.0, np.tile(self.aim, (4, 1)))
        seed = seed_for(self.config.seed, Purpose.EXPOSURE)
        whole = AppearancePass(self.scene, {}, self.shading, 64, 16, deferred_base=True)
        gbuffer = whole.trace(cameras, seed)
        return auto_exposure(whole.render_clay(gbuffer, seed), gbuffer.alpha, CLAY_LEVEL)


def _detached(pictures: AppearancePictures) -> AppearancePictures:
    return AppearancePictures(**{name: value.detach() for name, value in vars(pictures).items()})


def _without_gradient(texture: TextureValues) -> TextureValues:
    return TextureValues(**{name: value.detach() for name, value in vars(texture).items()})
