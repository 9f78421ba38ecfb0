"""The geometry stage's losses on the part's field itself, apart from every picture: L_GF, L_CA and three additions.

Each is a mean over samples at the grid's vertices; a weight of 0 turns its work off.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.sections import GeometryConfig
from fd_mitsuba.extraction.surface import Samples
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.losses.collision import loss_collision
from fd_mitsuba.losses.focal import loss_focal
from fd_mitsuba.losses.presence import loss_presence
from fd_mitsuba.losses.tether import loss_tether
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.tethers import THIN, Tethers

RIM_IN_CELLS = 2.0
"""Within this distance of the base a part touches it: the soft union joins them."""


class FieldLosses:
    """Where a step asks the field, and what the answers cost.

    Args:
        config: weights and settings, of its section `geometry`.
        grid: the grid.
        sdf_base: (count,) base sdf at its vertices, inside positive, canonical units.
        region_sdfs: (R, count) signed distance to each focal region there, inside positive.
        active_index: (A,) int64 vertices at which the part exists; samples are drawn from these.
        subtracts: whether the part is cut out of the base, which it then must enter: no L_CA, and nothing to hang on.

    Attributes:
        room: (., count) bool, vertices that must hold some of the part, a row each: a region, or its rim on the base.
    """

    def __init__(
        self,
        config: RunConfig,
        grid: TetGrid,
        sdf_base: Tensor,
        region_sdfs: Tensor,
        active_index: Tensor,
        subtracts: bool,
    ) -> None:
        self._geometry, self._seed, self._spacing = config.geometry, config.seed, grid.spacing
        self._sdf_base, self._region_sdf, self._active = sdf_base, region_sdfs.amax(dim=0), active_index
        self.room = region_sdfs > 0
        if not subtracts:
            outside = self.room & (sdf_base < 0)
            self.room = torch.cat([outside, outside & (sdf_base > -RIM_IN_CELLS * grid.spacing)])
        self._lambda_collision = 0.0 if subtracts else self._geometry.lambda_collision
        self._tethers: Tethers | None = None
        if tether_depth(self._geometry, grid, subtracts) is not None:
            within = self._region_sdf > -self._geometry.focal_band
            self._tethers = Tethers(grid, sdf_base, within, active_index)

    def draw(self, step: int) -> Tensor | None:
        """The step's vertices (S,) int64, random by (seed, step); None if no loss looks at any."""
        geometry = self._geometry
        additions = (geometry.lambda_volume, geometry.lambda_presence, self._tethers is not None)
        if not any((geometry.lambda_focal, self._lambda_collision, *additions)):
            return None
        if len(self._active) <= geometry.focal_samples:
            return self._active
        generator = torch.Generator().manual_seed(seed_for(self._seed, Purpose.SAMPLES, step))
        return self._active[torch.randint(len(self._active), (geometry.focal_samples,), generator=generator)]

    def with_tethers(self, samples: Tensor | None) -> Samples | None:
        """`draw`'s samples, and after them the vertices between the object and loose pieces where their loss counts."""
        tethers = self._tethers
        if samples is None or tethers is None:
            return samples
        return lambda deeper: torch.cat([samples, tethers.find(deeper)])

    def __call__(self, sdf_part: Tensor, samples: Tensor) -> dict[str, Tensor]:
        """The losses by the names of their weights, without the weights; gradients flow to `sdf_part`.

        Args:
            sdf_part: (S + T,) the field at `with_tethers(samples)`, inside positive, canonical units.
            samples: (S,) what `draw` gave.
        """
        geometry, losses = self._geometry, {}
        sdf, at_tethers = sdf_part[: len(samples)], sdf_part[len(samples) :]
        region = self._region_sdf[samples]
        if geometry.lambda_focal > 0:
            outside = region < 0
            distance = (-region[outside] - geometry.focal_band).clamp(min=0)
            losses["focal"] = loss_focal(
                sdf[outside],
                distance,
                geometry.focal_sigma_distance,
                geometry.focal_sigma_sdf,
                geometry.focal_margin,
            )
        if self._lambda_collision > 0:
            losses["collision"] = loss_collision(self._sdf_base[samples], sdf)
        if geometry.lambda_volume > 0:
            losses["volume"] = (0.5 + sdf / (2 * self._spacing)).clamp(0, 1).mean()
        if geometry.lambda_presence > 0:
            depth = 0.5 * self._spacing
            losses["presence"] = loss_presence(sdf, self.room[:, samples], geometry.presence_share, depth)
        if self._tethers is not None:
            losses["tether"] = loss_tether(at_tethers, self._spacing)
        return losses


def tether_depth(geometry: GeometryConfig, grid: TetGrid, subtracts: bool) -> float | None:
    """How deep a part must be not to count as worn away, canonical units; None where loose pieces cost nothing."""
    return THIN * grid.spacing if geometry.lambda_tether > 0 and not subtracts else None
