"""Where a step of the geometry stage asks the part's field, and what the losses of `geometry_losses` make of it.

Each is a mean over samples at the grid's vertices; a weight of 0 turns its work off.
"""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.sections import GeometryConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.extraction.surface import Samples
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.training.geometry_losses import GEOMETRY_LOSSES, FieldLoss, FieldPlace, FieldSamples, built_in_losses
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.tethers import THIN, Tethers

RIM_IN_CELLS = 2.0
"""Within this distance of the base a part touches it: the soft union joins them."""


class FieldLosses:
    """The losses of a stage.

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
        active_index: GridVertices,
        subtracts: bool,
    ) -> None:
        self._geometry, self._seed, self._active = config.geometry, config.seed, active_index
        self.room = region_sdfs > 0
        if not subtracts:
            outside = self.room & (sdf_base < 0)
            self.room = torch.cat([outside, outside & (sdf_base > -RIM_IN_CELLS * grid.spacing)])
        region_sdf = region_sdfs.amax(dim=0)
        self._place = FieldPlace(grid.vertices, sdf_base, region_sdf, self.room, grid.spacing, subtracts, config.seed)
        self._tethers: Tethers | None = None
        if tether_depth(self._geometry, grid, subtracts) is not None:
            within = region_sdf > -self._geometry.focal_band
            self._tethers = Tethers(grid, sdf_base, within, active_index)

    @cached_property
    def _losses(self) -> dict[str, tuple[float, FieldLoss]]:
        """Weight and loss by name. Made when first asked for: an export needs none, nor the modules that have them."""
        geometry = self._geometry
        wanted = {name: (*entry, f"geometry.lambda_{name}") for name, entry in built_in_losses(geometry).items()}
        for name, loss in geometry.losses.items():
            wanted[name] = loss.weight, loss.choice(name), f"geometry.losses.{name}"
        made = {
            name: (weight, GEOMETRY_LOSSES.make(choice, key))
            for name, (weight, choice, key) in wanted.items()
            if weight > 0
        }
        return {name: found for name, found in made.items() if found[1].in_cuts or not self._place.subtracts}

    @property
    def weights(self) -> dict[str, float]:
        """Those of the losses that count."""
        return {name: weight for name, (weight, _) in self._losses.items()}

    def draw(self, step: int) -> GridVertices | None:
        """The step's vertices (S,) int64, random by (seed, step); None if no loss looks at any."""
        if not self._losses:
            return None
        count = self._geometry.focal_samples
        if len(self._active) <= count:
            return self._active
        generator = torch.Generator().manual_seed(seed_for(self._seed, Purpose.SAMPLES, step))
        return GridVertices(self._active[torch.randint(len(self._active), (count,), generator=generator)])

    def with_tethers(self, samples: GridVertices | None) -> Samples | None:
        """`draw`'s samples, and after them the vertices between the object and loose pieces where their loss counts."""
        tethers = self._tethers
        if samples is None or tethers is None:
            return samples
        return lambda deeper: GridVertices(torch.cat([samples, tethers.find(deeper)]))

    def __call__(self, sdf_part: Tensor, samples: GridVertices, step: int = 0) -> dict[str, Tensor]:
        """The losses by their names, without the weights; gradients flow to `sdf_part`.

        Args:
            sdf_part: (S + T,) the field at `with_tethers(samples)`, inside positive, canonical units.
            samples: (S,) what `draw` gave.

        Raises:
            UserError: a loss of another module is no number.
        """
        sdf, at_tethers = sdf_part[: len(samples)], sdf_part[len(samples) :]
        at = FieldSamples(sdf, samples, at_tethers, self._place, step)
        losses = {name: loss(at) for name, (_, loss) in self._losses.items()}
        check_scalars(losses, "geometry")
        return losses


def check_scalars(losses: dict[str, Tensor], section: str) -> None:
    """UserError where what a loss gave cannot be added up."""
    for name, loss in losses.items():
        if not isinstance(loss, Tensor) or loss.dim():
            got = f"a tensor of shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
            raise UserError(f"{section}.losses.{name}: gives {got}, not a scalar tensor; mend its module")


def tether_depth(geometry: GeometryConfig, grid: TetGrid, subtracts: bool) -> float | None:
    """How deep a part must be not to count as worn away, canonical units; None where loose pieces cost nothing."""
    return THIN * grid.spacing if geometry.lambda_tether > 0 and not subtracts else None
