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
from fd_mitsuba.losses.curvature import STENCIL
from fd_mitsuba.training.geometry_losses import GEOMETRY_LOSSES, FieldLoss, FieldPlace, FieldSamples, built_in_losses
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.surface_stencils import SurfaceStencils
from fd_mitsuba.training.tethers import THIN, Tethers

RIM_IN_CELLS = 2.0
"""Within this distance of the base a part touches it: the soft union joins them."""
_STENCILS = 512
"""Places beside the surface at which a step looks at its curvature, at most: 2 % of a step's time."""


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
        if self._geometry.lambda_tether > 0 and not subtracts:
            within = region_sdf > -self._geometry.focal_band
            self._tethers = Tethers(grid, sdf_base, within, active_index)
        self._stencils: SurfaceStencils | None = None
        if self._geometry.lambda_curvature > 0 and not subtracts:
            self._stencils = SurfaceStencils(grid, sdf_base, active_index, _STENCILS)

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

    def ask(self, step: int) -> AskedVertices | None:
        """Where the step wants the field, random by (seed, step); None if no loss looks at it."""
        if not self._losses:
            return None
        drawn, count = self._active, self._geometry.focal_samples
        if len(drawn) > count:
            generator = torch.Generator().manual_seed(seed_for(self._seed, Purpose.SAMPLES, step))
            drawn = GridVertices(drawn[torch.randint(len(drawn), (count,), generator=generator)])
        return AskedVertices(drawn, self._tethers, self._stencils, seed_for(self._seed, Purpose.LOSSES, step))

    def __call__(self, sdf_part: Tensor, asked: AskedVertices, step: int = 0) -> dict[str, Tensor]:
        """The losses by their names, without the weights; gradients flow to `sdf_part`.

        Args:
            sdf_part: (M,) the field at the vertices of `asked`, inside positive, canonical units.
            asked: what `ask` gave.

        Raises:
            UserError: a loss of another module is no number.
        """
        sdf, at_tethers, at_surface = asked.split(sdf_part)
        at = FieldSamples(sdf, asked.drawn, at_tethers, self._place, step, at_surface)
        losses = {name: loss(at) for name, (_, loss) in self._losses.items()}
        check_scalars(losses, "geometry")
        return losses


class AskedVertices:
    """The vertices of the grid at which a step wants the field: drawn ones, then those that depend on the part.

    These are chosen while the surface is extracted, when it is known where the part is: an extractor calls this.

    Args:
        drawn: (S,) vertices.
        tethers, stencils: what chooses T vertices between loose pieces, and K stencils beside the surface; None: none.
        seed: of the stencils' choice.
    """

    def __init__(
        self, drawn: GridVertices, tethers: Tethers | None, stencils: SurfaceStencils | None, seed: int
    ) -> None:
        self.drawn, self._tethers, self._stencils, self._seed = drawn, tethers, stencils, seed
        self._count = 0

    @property
    def samples(self) -> Samples:
        """What an extractor takes: vertices, where they do not depend on the part."""
        return self.drawn if self._tethers is None and self._stencils is None else self

    def __call__(self, deeper: Tensor) -> GridVertices:
        """All (S + T + 19 K,), by whether (A,) the part is deeper than `asked_depth` at the active vertices."""
        held = self.drawn[:0] if self._tethers is None else self._tethers.find(deeper)
        beside = self.drawn[:0] if self._stencils is None else self._stencils.find(deeper, self._seed)
        self._count = len(held)
        return GridVertices(torch.cat([self.drawn, held, beside]))

    def split(self, sdf_part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The field (S,) at the drawn ones, (T,) at tethers, (K, 19) at stencils, of that at all of them."""
        ends = (len(self.drawn), len(self.drawn) + self._count)
        drawn, held, beside = sdf_part.tensor_split(ends)
        return drawn, held, beside.view(-1, len(STENCIL))


def check_scalars(losses: dict[str, Tensor], section: str) -> None:
    """UserError where what a loss gave cannot be added up."""
    for name, loss in losses.items():
        if not isinstance(loss, Tensor) or loss.dim():
            got = f"a tensor of shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
            raise UserError(f"{section}.losses.{name}: gives {got}, not a scalar tensor; mend its module")


def asked_depth(geometry: GeometryConfig, grid: TetGrid, subtracts: bool) -> float | None:
    """How deep a part is that counts where vertices depend on it, canonical units; None where none do.

    What is thinner counts as worn away: a stalk is held before it breaks.
    """
    depends = geometry.lambda_tether > 0 or geometry.lambda_curvature > 0
    return THIN * grid.spacing if depends and not subtracts else None
