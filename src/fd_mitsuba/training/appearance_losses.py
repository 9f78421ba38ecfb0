"""The appearance stage's losses on the texture field itself, apart from every picture: L_g, L_b and L_bend.

An entry of `APPEARANCE_LOSSES` each. The built-in ones have their weights and settings in the section `appearance`, as
`lambda_bend` and `style_samples`; those of other modules in `appearance.losses`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from fd_mitsuba.config import AppearanceConfig, RunConfig, Section
from fd_mitsuba.config.bounds import Points, Width
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.registry import Registry
from fd_mitsuba.fields.texture import TextureField, TextureValues
from fd_mitsuba.fields.textures_apart import TexturesApart
from fd_mitsuba.losses.bend import loss_bend
from fd_mitsuba.losses.style import jittered, loss_style_boundary, loss_style_gradient
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.field_losses import check_scalars
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.surface_points import chosen_rows


class PartSurface:
    """What the texture field lies on; made once a stage.

    Attributes:
        points: (N, 3) canonical, uniform on the parts' surface.
        learned: the channels that the field learns.
        run_seed: of the run.
        say: takes a remark for the user.
    """

    def __init__(
        self, scene: EditScene, points: Tensor, learned: tuple[str, ...], run_seed: int, say: Callable[[str], None]
    ) -> None:
        self.points, self.learned, self.run_seed, self.say = points, learned, run_seed, say
        self._scene = scene

    @cached_property
    def base(self) -> BaseAppearance:
        """Looks the base's material up; what of it cannot be read is said once."""
        base = BaseAppearance(self._scene)
        for remark in base.unreadable:
            self.say(remark)
        return base

    def chosen(self, count: int, size: int, step: int) -> Tensor:
        """At most `size` of `count` row numbers, random by (seed, step)."""
        return chosen_rows(count, size, seed_for(self.run_seed, Purpose.STYLE, step))


@dataclass(frozen=True)
class TextureSamples:
    """The texture field in one step; what a loss may use.

    Attributes:
        texture: the field's values at the N points of the part that the views see. Gradients flow to them.
        gbuffer: the views: `gbuffer.points` (N, 3) canonical, and much more.
        field: asked at other points (M, 3) by calling it.
        step: counted from 0.
        seed: for random numbers of a loss: follows from the run's seed and the step.
    """

    texture: TextureValues
    gbuffer: GBuffer
    field: TextureField | TexturesApart
    step: int
    seed: int


class AppearanceLoss(ABC):
    """A loss on the texture field.

    Attributes:
        settings: its own, as the registry has checked them.
        surface: what the field lies on.
    """

    def __init__(self, settings: Any, surface: PartSurface) -> None:
        self.settings, self.surface = settings, surface

    @abstractmethod
    def __call__(self, at: TextureSamples) -> Tensor | None:
        """A scalar, without its weight, whose gradients flow to the field; None where there is nothing to look at."""


APPEARANCE_LOSSES: Registry[type[AppearanceLoss]] = Registry("appearance_losses", "appearance loss")
"""Called with their settings and the `PartSurface`."""


class StyleGradientSettings(Section):
    """Of `style_gradient`."""

    samples: Points = 2048
    jitter: Width = 0.01


@APPEARANCE_LOSSES.register("style_gradient", StyleGradientSettings)
class StyleGradient(AppearanceLoss):
    """L_g: the part's material is smooth; paper, "Style Consistency"; see `loss_style_gradient`."""

    def __call__(self, at: TextureSamples) -> Tensor:
        points = self.surface.points
        points = points[self.surface.chosen(len(points), self.settings.samples, at.step)]
        jitter_seed = seed_for(self.surface.run_seed, Purpose.STYLE_JITTER, at.step)
        moved = jittered(points, self.settings.jitter, torch.Generator().manual_seed(jitter_seed))
        return loss_style_gradient(at.field(points).style(), at.field(moved).style())


class StyleBoundarySettings(Section):
    """Of `style_boundary`."""

    samples: Points = 2048
    reach: Width = 0.03


@APPEARANCE_LOSSES.register("style_boundary", StyleBoundarySettings)
class StyleBoundary(AppearanceLoss):
    """L_b: the part's material continues the base's where they meet; paper, "Style Consistency".

    Attributes:
        boundary: (M, 3) the points within reach of the base; M may be 0.
        beside: the base's material at the nearest point of its surface.
    """

    def __init__(self, settings: StyleBoundarySettings, surface: PartSurface) -> None:
        super().__init__(settings, surface)
        self.boundary = surface.points[surface.base.distance(surface.points) < settings.reach]
        self.beside = surface.base.lookup(self.boundary)
        if not len(self.boundary):
            surface.say(
                f"style consistency: no point of the part is within {settings.reach} of the base, so nothing "
                "ties its colours to the base; raise appearance.boundary_reach"
            )

    def __call__(self, at: TextureSamples) -> Tensor | None:
        if not len(self.boundary):
            return None
        rows = self.surface.chosen(len(self.boundary), self.settings.samples, at.step)
        part = at.field(self.boundary[rows]).style()
        # Where the base's BSDF says nothing, nothing is asked of the part.
        base = torch.where(self.beside.known[rows], self.beside.style()[rows], part.detach())
        return loss_style_boundary(part, base)


@APPEARANCE_LOSSES.register("bend")
class Bend(AppearanceLoss):
    """What a bend of the shading normal costs; see `loss_bend`. Nothing where normals are not learned."""

    def __call__(self, at: TextureSamples) -> Tensor | None:
        return loss_bend(at.texture.normal) if "normal" in self.surface.learned else None


def built_in_losses(settings: AppearanceConfig) -> dict[str, tuple[float, Choice]]:
    """Weight and settings of the losses that the section names itself, in the order in which they are added up."""
    smooth = {"samples": settings.style_samples, "jitter": settings.style_jitter}
    meets = {"samples": settings.style_samples, "reach": settings.boundary_reach}
    style = settings.lambda_style if settings.style else 0.0
    return {
        "style_gradient": (style, Choice.of("style_gradient", smooth)),
        "style_boundary": (style * settings.lambda_boundary, Choice.of("style_boundary", meets)),
        "bend": (settings.lambda_bend, Choice.of("bend")),
    }


class AppearanceLosses:
    """The losses of a stage; those with a weight of 0 are not made.

    Attributes:
        built_in: by name; the others are made when first asked for: an export needs none, nor the modules that have
            them.
    """

    def __init__(self, config: RunConfig, surface: PartSurface) -> None:
        self._settings, self._surface = config.appearance, surface
        own = built_in_losses(config.appearance)
        self.built_in: dict[str, AppearanceLoss] = {
            name: APPEARANCE_LOSSES.make(choice, f"appearance.lambda_{name}", surface)
            for name, (weight, choice) in own.items()
            if weight > 0
        }
        self.weights = {name: weight for name, (weight, _) in own.items()}
        self.weights |= {name: loss.weight for name, loss in config.appearance.losses.items()}

    @cached_property
    def _losses(self) -> dict[str, AppearanceLoss]:
        others = {
            name: APPEARANCE_LOSSES.make(loss.choice(name), f"appearance.losses.{name}", self._surface)
            for name, loss in self._settings.losses.items()
            if loss.weight > 0
        }
        return {**self.built_in, **others}

    def __call__(
        self, texture: TextureValues, gbuffer: GBuffer, field: TextureField | TexturesApart, step: int
    ) -> dict[str, Tensor]:
        """The losses by their names, without the weights; UserError where one of another module is no number."""
        seed = seed_for(self._surface.run_seed, Purpose.LOSSES, step)
        at = TextureSamples(texture, gbuffer, field, step, seed)
        found = {name: loss(at) for name, loss in self._losses.items()}
        losses = {name: value for name, value in found.items() if value is not None}
        check_scalars(losses, "appearance")
        return losses
