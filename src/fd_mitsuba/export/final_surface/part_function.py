"""A part's solid as a function of space, not of a lattice: what `part_solid` marches, at any point, with its gradient.

    part   = min(region + learned, region + margin, room)      where the part may be at all
    shown  = part, and near the base what the training's union adds to it (`shown_part`)
    blend  = shown, but foot - away at the base's surface and inside it, from one to the other within 0.5 k
    joined = max(sdf_base - 2 max(away - reach, 0), blend) + fillet(sdf_base, blend)
    value  = min(joined, sink - sdf_base, lead)        positive inside the solid

`sdf_base` is the exact distance to triangles, `region` that to the focal regions, and `learned` a spline through what
the field adds to it at the vertices of the training's lattice (`learned`). See `part_solid` for `joined`, `sink` and
`lead`. `away` is the smoothed distance to where the part is seen to stand on the base (`contact`): the curve along
which the solid dives under the base, two down for one along, is a level line of it. The part widens by `foot` towards
the base: smoothed distances shrink what is thin, which would leave a groove around the part. The edge at `sink` is
rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.export.final_surface.fillet import fillet, foot_width, rounded_minimum, shown_part, smoothstep
from fd_mitsuba.export.final_surface.projection import FLATTEST
from fd_mitsuba.export.final_surface.spline import LatticeSpline
from fd_mitsuba.export.solid.part_pieces import Bridge, bridge_weight
from fd_mitsuba.extraction.active_vertices import DEFAULT_MARGIN
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.scene.focal_region import FocalRegion, union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance

_BLEND = 0.5
"""How far over the base the part becomes the smoothed one, in `k`."""
_STEP = 1e-3
"""Of the differences that a region's gradient is made of, canonical units."""
_AT_ONCE = 1 << 16
_DIVE = 2.0
"""How steeply the solid dives under the base: a steep rim lies where it lies, whatever the triangles beside it."""
_ROUND_CELLS = 0.75
"""Of the solid's lower edge, which nobody sees: triangles across a sharp one would be off its surface."""


@dataclass(frozen=True)
class PartFunction:
    """What a part's solid is made of.

    Attributes:
        learned: what the part's field adds to the distance to the regions.
        parts: the regions of all named parts.
        number: the part that is meant; None: all together.
        grid: the lattice of the training; the part keeps away from its border.
        base: the base's surface; None where the part is cut out: then the solid is the part alone.
        width: of the fillet, canonical units: the `k` of `soft_union`.
        union_only_outside: see `soft_union`.
        reach: how far from the part the fillet is shown, canonical units.
        sink: see `part_solid`.
        base_lattice: (z, y, x) base sdf at the grid's vertices, to tell where the base is far away.
        bridges: where the part swells to reach the base.
        surface: the part's own surface before it swells, for that; None: not known yet.
        contact: how far a point is from where the part stands on the base; None: nowhere near.
    """

    learned: LatticeSpline
    parts: Sequence[Sequence[FocalRegion]]
    number: int | None
    grid: TetGrid
    base: MeshDistance | None
    width: float
    union_only_outside: bool
    reach: float
    sink: float
    base_lattice: np.ndarray
    bridges: Sequence[Bridge] = ()
    surface: MeshDistance | None = None
    contact: LatticeSpline | None = None

    def values(self, points: np.ndarray) -> np.ndarray:
        """The value (N,) float64 at points (N, 3), canonical."""
        with torch.no_grad():
            return self._in_pieces(points, lambda x: self._compose(x)[:, None])[:, 0]

    def part_values(self, points: np.ndarray) -> np.ndarray:
        """`part` (N,) alone, before it swells towards the base."""
        with torch.no_grad():
            return self._in_pieces(points, lambda x: self._part(x, False)[:, None])[:, 0]

    def shown_values(self, points: np.ndarray) -> np.ndarray:
        """`shown` (N,) alone, after the part has swollen towards the base."""

        def shown(x: Tensor) -> Tensor:
            value, near = self._part(x, True), torch.from_numpy(np.flatnonzero(self._near_base(x)))
            if len(near):
                value = value.index_copy(0, near, shown_part(self._base_at(x[near]), value[near], self.width))
            return value[:, None]

        with torch.no_grad():
            return self._in_pieces(points, shown)[:, 0]

    def with_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The value (N,) and its gradient (N, 3), float64; in a crease that of either side."""

        def both(x: Tensor) -> Tensor:
            x = x.requires_grad_()
            value = self._compose(x)
            (gradient,) = torch.autograd.grad(value.sum(), x)
            return torch.cat([value.detach()[:, None], gradient], dim=1)

        rows = self._in_pieces(points, both)
        return rows[:, 0], rows[:, 1:]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """About how far (N,) points (N, 3) are from the zero set, canonical units: |value| / |gradient|."""
        values, slopes = self.with_gradient(points)
        return np.abs(values) / np.maximum(np.linalg.norm(slopes, axis=1), FLATTEST)

    def rim(self, points: np.ndarray, within: float) -> tuple[np.ndarray, np.ndarray]:
        """Two values (N, 2), and gradients (N, 2, 3), that are 0 along the rim where the solid dives under the base.

        The first is how much further than `reach` from the part, the second 0 on the surface as if it did not dive.
        Infinite, with gradients of 0, where no base is near, or the first is larger than `within`, canonical units.
        """
        points = np.asarray(points, dtype=np.float64)
        values, gradients = np.full((len(points), 2), np.inf), np.zeros((len(points), 2, 3))
        if self.contact is None:
            return values, gradients
        x = torch.from_numpy(points.astype(np.float32))
        near = np.flatnonzero(self._nearest(self.base_lattice, x) > -2 * self.grid.spacing)
        from_part, slope = self.contact.at(points[near])
        close = np.abs(from_part - self.reach) <= within
        near = near[close]
        x = x[torch.from_numpy(near)].requires_grad_()
        away = _attached(x, from_part[close], slope[close])
        base, part = self._base_at(x), self._part(x, True)
        for number, value in enumerate([away - self.reach, self._joined(base, part, away, 0)]):
            (gradient,) = torch.autograd.grad(value.sum(), x, retain_graph=True)
            values[near, number], gradients[near, number] = value.detach().numpy(), gradient.numpy()
        return values, gradients

    def base_values(self, points: np.ndarray) -> np.ndarray:
        """`sdf_base` (N,) at points (N, 3); far outside where there is no base."""
        return np.full(len(points), -np.inf) if self.base is None else self.base.signed(points)

    def _in_pieces(self, points: np.ndarray, function: Callable[[Tensor], Tensor]) -> np.ndarray:
        points = np.asarray(points, dtype=np.float32).reshape(-1, 3)
        rows = [function(torch.from_numpy(points[i : i + _AT_ONCE])) for i in range(0, len(points), _AT_ONCE)]
        return torch.cat(rows).double().numpy() if rows else np.zeros((0, 4))

    def _compose(self, x: Tensor) -> Tensor:
        value = part = self._part(x, True)
        near = torch.from_numpy(np.flatnonzero(self._near_base(x)))
        if len(near):
            chosen = x[near]
            value = part.index_copy(0, near, self._beside_base(chosen, part[near], self._base_at(chosen)))
        if self.number is None or len(self.parts) == 1:
            return value
        depths = [self._region(regions, x) for regions in self.parts]
        others = torch.stack(depths[: self.number] + depths[self.number + 1 :]).amax(dim=0)
        return torch.minimum(value, (depths[self.number] - others) / 2)

    def _near_base(self, x: Tensor) -> np.ndarray:
        """Whether (N,) the base may have a say: elsewhere it is too far below the part for a fillet or a rim."""
        if self.base is None:
            return np.zeros(len(x), dtype=bool)
        swelling = max((bridge.gap + 2 * bridge.swelling for bridge in self.bridges), default=0.0)
        return self._nearest(self.base_lattice, x) > -(max(self.width, swelling) + 2 * self.grid.spacing)

    def _beside_base(self, x: Tensor, part: Tensor, base: Tensor) -> Tensor:
        if self.contact is None:
            return torch.minimum(part, self.sink - base)
        away = self._spline_at(self.contact, x)
        joined = self._joined(base, part, away, _DIVE * (away - self.reach).clamp(min=0))
        return rounded_minimum(joined, self.sink - base, _ROUND_CELLS * self.grid.spacing)

    def _joined(self, base: Tensor, part: Tensor, away: Tensor, lower: Tensor | float) -> Tensor:
        if self.width > 0:
            foot = foot_width(self.width, self.grid.spacing)
            part = shown_part(base, part, self.width)
            part = torch.lerp(part, foot - away, smoothstep(1 + base / (_BLEND * self.width)))
        higher = torch.maximum(base - lower, part)
        added = fillet(base, part, self.width)
        # Beyond the rim the fillet goes on below the base's surface, or the solid would end on it in a ledge.
        return higher + (torch.where(higher < 0, added, 0.0) if self.union_only_outside else added)

    def _part(self, x: Tensor, swollen: bool) -> Tensor:
        region = self._region([region for regions in self.parts for region in regions], x)
        room = self.grid.half_extent - 0.5 * self.grid.spacing - x.abs().amax(dim=1)
        part = torch.minimum(region + self._spline_at(self.learned, x).clamp(max=DEFAULT_MARGIN), room)
        near = torch.from_numpy(np.flatnonzero(self._near_base(x)))
        if not swollen or not self.bridges or not len(near):
            return part
        chosen, own = x[near], part[near]
        base, true = self._base_at(chosen), torch.maximum(own, -self._distance_to(self.surface, chosen))
        for bridge in self.bridges:
            weight = bridge_weight(base, bridge) * torch.from_numpy(self._nearest(bridge.own, chosen))
            own = torch.where(weight > 0, torch.maximum(own, true + bridge.swelling * weight), own)
        return part.index_copy(0, near, own)

    def _nearest(self, lattice: np.ndarray, x: Tensor) -> np.ndarray:
        """The value of `lattice` (z, y, x) at the vertex next to each point."""
        grid = self.grid
        index = ((x.detach().numpy() + grid.half_extent) / grid.spacing).round().astype(int).clip(0, grid.resolution)
        return lattice[index[:, 2], index[:, 1], index[:, 0]].astype(np.float32)

    def _base_at(self, x: Tensor) -> Tensor:
        assert self.base is not None
        points = x.detach().double().numpy()
        distance, away = self._from(self.base, points)
        sign = np.sign(self._nearest(self.base_lattice, x)).astype(np.float64)
        near = np.flatnonzero(distance < self.grid.spacing)  # elsewhere the vertex next to it is on the same side
        sign[near] = np.where(self.base.inside(points[near]), 1.0, -1.0)
        return _attached(x, sign * distance, sign[:, None] * away)

    def _distance_to(self, surface: MeshDistance | None, x: Tensor) -> Tensor:
        """The distance (N,) to a surface; 0 everywhere while it is not known."""
        if surface is None:
            return torch.zeros(len(x))
        return _attached(x, *self._from(surface, x.detach().double().numpy()))

    @staticmethod
    def _spline_at(spline: LatticeSpline, x: Tensor) -> Tensor:
        return _attached(x, *spline.at(x.detach().double().numpy()))

    @staticmethod
    def _from(mesh: MeshDistance, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The distance (N,) to a mesh's triangles and its gradient (N, 3)."""
        offset = points - mesh.feet(points)
        distance = np.linalg.norm(offset, axis=1)
        return distance, offset / np.maximum(distance, 1e-12)[:, None]

    def _region(self, regions: Sequence[FocalRegion], x: Tensor) -> Tensor:
        points = x.detach().double().numpy()
        value = union_sdf(list(regions), points)
        if not x.requires_grad:
            return torch.from_numpy(value)
        gradient = np.empty_like(points)
        for axis, step in enumerate(np.eye(3) * _STEP):
            # One-sided: half the time for an error of half a step over the region's radius.
            gradient[:, axis] = (union_sdf(list(regions), points + step).astype(np.float64) - value) / _STEP
        return _attached(x, value, gradient)


def _attached(x: Tensor, value: np.ndarray, gradient: np.ndarray) -> Tensor:
    """Values (N,) of a function of `x` (N, 3) that torch takes for one with the given gradient (N, 3)."""
    constant = torch.from_numpy(np.asarray(value, dtype=np.float32))
    if not x.requires_grad:
        return constant
    slope = torch.from_numpy(gradient.astype(np.float32))
    return constant + (slope * (x - x.detach())).sum(dim=1)
