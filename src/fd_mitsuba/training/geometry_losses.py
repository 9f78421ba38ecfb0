"""The geometry stage's losses on the part's field itself, apart from every picture: L_GF, L_CA and four additions.

An entry of `GEOMETRY_LOSSES` each. The built-in ones have their weights and settings in the section `geometry`, as
`lambda_focal` and `focal_band`; those of other modules in `geometry.losses`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from fd_mitsuba.config import GeometryConfig, Section
from fd_mitsuba.config.bounds import Length, Width
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.registry import Registry
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.losses.collision import loss_collision
from fd_mitsuba.losses.curvature import STENCIL, loss_curvature
from fd_mitsuba.losses.focal import loss_focal
from fd_mitsuba.losses.presence import loss_presence
from fd_mitsuba.losses.tether import loss_tether
from fd_mitsuba.training.seeds import Purpose, seed_for


@dataclass(frozen=True)
class FieldPlace:
    """What the field stands in, at all vertices of the grid; canonical units, inside positive, no gradients.

    Attributes:
        positions: (count, 3).
        sdf_base, region_sdf: (count,) to the base, to the union of the focal regions.
        room: (R, count) bool, vertices that must hold some of the part, a row each: a region, or its rim on the base.
        spacing: side of a grid cell.
        subtracts: whether the part is cut out of the base.
        run_seed: of the run.
    """

    positions: Tensor
    sdf_base: Tensor
    region_sdf: Tensor
    room: Tensor
    spacing: float
    subtracts: bool
    run_seed: int


@dataclass(frozen=True)
class FieldSamples:
    """The field at the step's sample points; what a loss may use.

    Attributes:
        sdf_part: (S,) inside positive, canonical units. Gradients flow to it.
        index: (S,) int64, the vertices of `place` that the samples are.
        at_tethers: (T,) the field where loose pieces should hang on; empty unless `lambda_tether` is set.
        place: the same data for all vertices.
        step: counted from 0 over the stage.
        at_surface: (K, 19) the field beside the part's surface and around there, in the order of
            `losses.curvature.STENCIL`; empty unless `lambda_curvature` is set.
    """

    sdf_part: Tensor
    index: GridVertices
    at_tethers: Tensor
    place: FieldPlace
    step: int
    at_surface: Tensor = field(default_factory=lambda: torch.zeros(0, len(STENCIL)))

    @property
    def positions(self) -> Tensor:
        """(S, 3) canonical."""
        return self.place.positions[self.index]

    @property
    def sdf_base(self) -> Tensor:
        """(S,) to the base."""
        return self.place.sdf_base[self.index]

    @property
    def region_sdf(self) -> Tensor:
        """(S,) to the union of the focal regions."""
        return self.place.region_sdf[self.index]

    @property
    def room(self) -> Tensor:
        """(R, S) bool, see `FieldPlace`."""
        return self.place.room[:, self.index]

    @property
    def spacing(self) -> float:
        """Side of a grid cell."""
        return self.place.spacing

    @property
    def seed(self) -> int:
        """For random numbers of a loss; follows from the run's seed and the step."""
        return seed_for(self.place.run_seed, Purpose.LOSSES, self.step)


class FieldLoss(ABC):
    """A loss on the part's field.

    Attributes:
        in_cuts: whether it counts where the part is cut out of the base.
        settings: its own, as the registry has checked them.
    """

    in_cuts: ClassVar[bool] = True

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @abstractmethod
    def __call__(self, at: FieldSamples) -> Tensor:
        """A scalar, without its weight, whose gradients flow to `at.sdf_part`."""


GEOMETRY_LOSSES: Registry[type[FieldLoss]] = Registry("geometry_losses", "geometry loss")
"""Called with their settings."""


class FocalSettings(Section):
    """Of `focal`."""

    sigma_distance: Width = 0.05
    sigma_sdf: Width = 0.01
    margin: Length = 0.0
    band: Length = 0.05


@GEOMETRY_LOSSES.register("focal", FocalSettings)
class Focal(FieldLoss):
    """L_GF: the part stays in its focal regions; see `loss_focal`."""

    def __call__(self, at: FieldSamples) -> Tensor:
        own, region = self.settings, at.region_sdf
        outside = region < 0
        distance = (-region[outside] - own.band).clamp(min=0)
        return loss_focal(at.sdf_part[outside], distance, own.sigma_distance, own.sigma_sdf, own.margin)


@GEOMETRY_LOSSES.register("collision")
class Collision(FieldLoss):
    """L_CA: the part does not grow into the base; see `loss_collision`. A cut must."""

    in_cuts = False

    def __call__(self, at: FieldSamples) -> Tensor:
        return loss_collision(at.sdf_base, at.sdf_part)


@GEOMETRY_LOSSES.register("volume")
class Volume(FieldLoss):
    """Share of the sample points that lie in the part, smooth over two grid cells. A cut may be as large as it likes
    where the base is not, and how much of the base goes is for the guidance to say.
    """

    in_cuts = False

    def __call__(self, at: FieldSamples) -> Tensor:
        return (0.5 + at.sdf_part / (2 * at.spacing)).clamp(0, 1).mean()


class PresenceSettings(Section):
    """Of `presence`."""

    share: Width = 0.02


@GEOMETRY_LOSSES.register("presence", PresenceSettings)
class Presence(FieldLoss):
    """No focal region is left without a part; see `loss_presence`."""

    def __call__(self, at: FieldSamples) -> Tensor:
        return loss_presence(at.sdf_part, at.room, self.settings.share, 0.5 * at.spacing)


@GEOMETRY_LOSSES.register("tether")
class Tether(FieldLoss):
    """The part does not come loose from the object; see `loss_tether`. A cut has nothing to hang on."""

    in_cuts = False

    def __call__(self, at: FieldSamples) -> Tensor:
        return loss_tether(at.at_tethers, at.spacing)


@GEOMETRY_LOSSES.register("curvature")
class Curvature(FieldLoss):
    """A penalty on dents and creases of the part's surface; see `loss_curvature`. A cut should be as the base was."""

    in_cuts = False

    def __call__(self, at: FieldSamples) -> Tensor:
        return loss_curvature(at.at_surface, at.spacing)


def built_in_losses(geometry: GeometryConfig) -> dict[str, tuple[float, Choice]]:
    """Weight and settings of the losses that the section names itself, in the order in which they are added up."""
    focal = {name: getattr(geometry, f"focal_{name}") for name in FocalSettings.model_fields}
    options = {"focal": focal, "presence": {"share": geometry.presence_share}}
    names = ("focal", "collision", "volume", "presence", "tether", "curvature")
    return {name: (getattr(geometry, f"lambda_{name}"), Choice.of(name, options.get(name))) for name in names}
