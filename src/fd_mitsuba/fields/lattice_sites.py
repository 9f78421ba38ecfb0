"""The hash grid's features at fixed vertices of a tetrahedral grid, several times faster than point by point.

The sites lie on a lattice, and trilinear interpolation factors over the axes. So a box of sites needs each learned
vertex once instead of eight times per site, and the interpolation becomes three small matrix products,

    box = (A_z x A_y x A_x) rows[slots],

whose transposes are the backward pass. Slots and matrices are constants. A site reads two lattice vertices an axis, so
that most of a large matrix is zeros: along x and y it is cut into bands. The product along z, which has the most
results, comes last. It leaves out the box's columns without a site, a third of them around ellipsoids, and a large box
is cut into slabs for it: a slab reads a few lattice planes of each level only, and its results stay in the cache.

Gradients of vertices that share a row are added one after another in a fixed order, so repeated runs agree.

How the data lies, for one box of sites with C columns, that is lines along z in which there is a site:

    sites          | box 0 . . . . . . . . . . . . . . . | box 1 . . . |     `index`, and the rows of all results
                   | slab 0 . . . | slab 1 . . . | . . . |                   `_Slab.begin` to `_Slab.end`

    a slab's       column   0   1   2  . .  C-1                              `full`: (features, depth * C); a site is
    features       z = 0    .   o   o  . .   .                               at z * C + column, which is what
                   z = 1    .   .   o  . .   o                               `_Slab.inside` holds for each of its sites

    a column       is the line y * width + x of the box: `_Box.columns`; `_Box.spread` leads back
    a level        (z, y, x) lattice vertices that the box reads, `slots` their rows in the hash grid's table
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from fd_mitsuba.fields.axis_interpolation import AxisInterpolation, Banded, axis_matrix, band_of
from fd_mitsuba.fields.hash_grid import HashGrid
from fd_mitsuba.fields.index_spaces import GridVertices, Sites, TableRows

_SMALLEST_BOX = 32**3
"""Boxes below this number of sites are not split: a box costs about a millisecond whatever its size."""
_FULL_ENOUGH = 0.4
"""Boxes filled at least to this share are not split; an ellipsoid fills 0.52 of its own."""
_SLAB = 2**16
"""Sites of a slab, at about."""


@dataclass(frozen=True)
class _BoxLevel:
    axes: tuple[AxisInterpolation | None, AxisInterpolation | None]
    """Along x and y; None: the identity."""
    shape: tuple[int, int, int]
    """Lattice vertices along z, y, x."""
    slots: TableRows
    """(z * y * x) table row of each lattice vertex, int64."""
    in_columns: bool
    """Whether along x and y lattice vertices are sites: then y and x are one, and hold the box's columns only."""


@dataclass(frozen=True)
class _Slab:
    depth: int
    """Planes of sites."""
    inside: Tensor
    """Position of each wanted site, as z * C + place of its line in the box's `columns`; z counts from the slab."""
    begin: int
    end: int
    """Its sites among all."""
    levels: tuple[tuple[int, int, Tensor | None], ...]
    """For each level the first lattice plane that it reads, the one after the last, and the interpolation between."""


@dataclass(frozen=True)
class _Box:
    height: int
    width: int
    """Sites along y and x."""
    columns: Tensor
    """(C,) the lines along z with a wanted site, each as y * width + x, ascending."""
    spread: Tensor
    """(height * width,) the place of each line in `columns`, C where it is not there."""
    levels: tuple[_BoxLevel, ...]
    slabs: tuple[_Slab, ...]


@dataclass(frozen=True)
class SiteFeatures:
    """The features of all sites for one state of the table, as they come out: whole columns of the slabs.

    Copying them into the order of the sites takes as long as half a perceptron, and few are wanted at all.

    Attributes:
        none: (width, 0).
        slabs: for each slab its features (width, z * C), and the positions in it of the slab's sites.
    """

    none: Tensor
    slabs: list[tuple[Tensor, Tensor]]

    def columns(self, chosen: Sites) -> Tensor:
        """Those of the sites `chosen` (S,), ascending: (width, S)."""
        ends = torch.tensor([len(inside) for _, inside in self.slabs], dtype=torch.int64).cumsum(0)
        cuts = [0, *torch.searchsorted(chosen, ends).tolist()]
        found = [self.none]
        begin = 0
        for (full, inside), first, last in zip(self.slabs, cuts[:-1], cuts[1:], strict=True):
            found.append(full.index_select(1, inside[chosen[first:last] - begin]))
            begin += len(inside)
        return found[1] if len(found) == 2 else torch.cat(found, dim=1)


class LatticeSites:
    """Constants for evaluating one hash grid at chosen vertices of a cubic lattice.

    Args:
        grid: the hash grid; only its layout and dtype are read.
        axis: (n,) canonical coordinates of the lattice's vertices along each axis, ascending.
        index: (A,) int64 wanted vertices, numbered (z * n + y) * n + x.

    Attributes:
        index: the wanted vertices in the order in which features come out (grouped by box).
    """

    def __init__(self, grid: HashGrid, axis: Tensor, index: GridVertices) -> None:
        side = len(axis)
        coordinates = torch.stack([index // (side * side), index // side % side, index % side], dim=1)
        self._grid_width, self._features, self._rows = grid.width, grid.features, grid.table.shape[1]
        self._boxes: list[_Box] = []
        chosen: list[Tensor] = []
        begin = 0
        for members in _split(coordinates, torch.arange(len(index))):
            local = coordinates[members]
            low, high = local.amin(0), local.amax(0) + 1
            depth, height, width = (high - low).tolist()
            line = (local[:, 1] - low[1]) * width + local[:, 2] - low[2]
            columns = line.unique()
            spread = torch.full((height * width,), len(columns)).index_copy_(0, columns, torch.arange(len(columns)))
            inside, order = ((local[:, 0] - low[0]) * len(columns) + spread[line]).sort()
            chosen.append(index[members[order]])
            axes = [axis[low[i] : high[i]] for i in (2, 1, 0)]
            levels, along_z = zip(
                *(_box_level(grid, level, axes, columns) for level in range(grid.levels)), strict=True
            )
            slabs = tuple(_slabs(depth, len(columns), inside, begin, along_z))
            self._boxes.append(_Box(height, width, columns, spread, levels, slabs))
            begin += len(local)
        self.index = GridVertices(torch.cat(chosen)) if chosen else index

    def __len__(self) -> int:
        return len(self.index)

    @torch.no_grad()
    def features(self, table: Tensor) -> SiteFeatures:
        """The features of all sites. No gradients."""
        slabs = []
        for box in self._boxes:
            planes = [self._planes(table, box, level) for level in box.levels]
            for slab in box.slabs:
                full = table.new_empty(self._grid_width, slab.depth, len(box.columns))
                outputs = full.view(-1, self._features, *full.shape[1:])
                for out, values, (first, last, along_z) in zip(outputs, planes, slab.levels, strict=True):
                    values = values[:, first:last]
                    out.copy_(values) if along_z is None else torch.matmul(along_z, values, out=out)
                slabs.append((full.view(self._grid_width, -1), slab.inside))
        return SiteFeatures(table.new_empty(self._grid_width, 0), slabs)

    def _planes(self, table: Tensor, box: _Box, level: _BoxLevel) -> Tensor:
        """A level's features (features, lattice planes, C) on the box's columns, interpolated along x and y."""
        values = table.index_select(1, level.slots)
        if not level.in_columns:
            along_x, along_y = level.axes
            if along_x is not None:
                values = along_x.to_sites.from_right(values.view(-1, level.shape[2]))
            values = values.view(-1, level.shape[1], box.width)
            if along_y is not None:
                values = along_y.to_sites.from_left(values)
            values = values.view(-1, box.height * box.width).index_select(1, box.columns)
        return values.view(self._features, level.shape[0], -1)

    def select(self, table: Tensor, features: SiteFeatures, chosen: Sites) -> Tensor:
        """`features.columns(chosen)` of `features(table)`, with gradients to `table`; `chosen` ascending and unique."""
        return _Select.apply(table, features.columns(chosen), chosen, self)

    def scatter_back(self, gradient: Tensor, chosen: Sites) -> Tensor:
        """The gradient (features, rows) of the table from that of the chosen sites' features (width, S)."""
        total = gradient.new_zeros(self._features, self._rows)
        for box in self._boxes:
            limits = torch.tensor([box.slabs[0].begin, *(slab.end for slab in box.slabs)])
            cuts = torch.searchsorted(chosen, limits).tolist()
            if cuts[0] == cuts[-1]:
                continue
            planes = self._planes_back(gradient, chosen, box, cuts)
            for level, values in zip(box.levels, planes, strict=True):
                if level.in_columns:
                    values = values[..., : len(box.columns)]
                else:
                    along_x, along_y = level.axes
                    values = values.view(-1, len(box.columns) + 1).index_select(1, box.spread)
                    if along_y is not None:
                        values = along_y.to_lattice.from_left(values.view(-1, box.height, box.width))
                    values = values.view(-1, box.width)
                    values = values if along_x is None else along_x.to_lattice.from_right(values)
                values = values.reshape(self._features, -1)
                for feature in range(self._features):
                    total[feature].index_add_(0, level.slots, values[feature])
        return total

    def _planes_back(self, gradient: Tensor, chosen: Sites, box: _Box, cuts: list[int]) -> list[Tensor]:
        """Each level's gradient (features, lattice planes, C + 1); the last column, of lines without a site, is 0.

        Args:
            cuts: where in `chosen` the first slab begins and each ends.
        """
        count = len(box.columns)
        planes = [gradient.new_zeros(self._features, level.shape[0], count + 1) for level in box.levels]
        for slab, begin, end in zip(box.slabs, cuts[:-1], cuts[1:], strict=True):
            full = gradient.new_zeros(self._features, slab.depth, count + 1)
            places = slab.inside[chosen[begin:end] - slab.begin]
            places = places + places // count
            for number, (values, (first, last, along_z)) in enumerate(zip(planes, slab.levels, strict=True)):
                # Every level fills the same places, so what lies between them stays 0.
                rows = gradient[number * self._features : (number + 1) * self._features]
                full.view(self._features, -1).index_copy_(1, places, rows[:, begin:end])
                values = values[:, first:last]
                if along_z is None:
                    values += full
                else:
                    torch.baddbmm(values, along_z.t().expand(self._features, -1, -1), full, out=values)
        return planes


class _Select(torch.autograd.Function):
    """Hands on `columns`, which were computed without gradients, as what they are: features that follow from `table`.

    So that all sites can be looked at in every step, and only the few that a loss reaches cost a backward pass.
    """

    @staticmethod
    def forward(ctx, table: Tensor, columns: Tensor, chosen: Sites, sites: LatticeSites) -> Tensor:  # type: ignore[override]
        ctx.sites = sites
        ctx.save_for_backward(chosen)
        return columns

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):  # type: ignore[override]
        (chosen,) = ctx.saved_tensors
        return ctx.sites.scatter_back(gradient.contiguous(), chosen), None, None, None


def _split(coordinates: Tensor, members: Tensor) -> list[Tensor]:
    """Groups of sites whose bounding boxes are small or mostly filled; a sparse box is cut across its longest side."""
    if len(members) == 0:
        return []
    local = coordinates[members]
    low, high = local.amin(0), local.amax(0) + 1
    volume = int((high - low).prod())
    if volume <= _SMALLEST_BOX or len(members) >= _FULL_ENOUGH * volume:
        return [members]
    longest = int((high - low).argmax())
    below = local[:, longest] < (low[longest] + high[longest]) // 2
    return _split(coordinates, members[below]) + _split(coordinates, members[~below])


def _box_level(grid: HashGrid, level: int, axes: list[Tensor], columns: Tensor) -> tuple[_BoxLevel, Tensor | None]:
    """A level's constants, and its interpolation along z (sites, lattice planes); None: the identity."""
    axis_matrices, keys = [], []
    for number, coordinate in enumerate(axes):
        matrix, vertices = axis_matrix(grid, level, coordinate)
        is_identity = matrix.shape[0] == matrix.shape[1] and torch.equal(
            matrix, torch.eye(len(matrix), dtype=matrix.dtype)
        )
        axis_matrices.append(None if is_identity else matrix.to(grid.table.dtype))
        keys.append(grid.axis_key(level, number, vertices))
    slots = keys[2][:, None] ^ (keys[1][:, None] ^ keys[0]).reshape(-1)
    *across, along_z = axis_matrices
    along_x, along_y = (None if m is None else AxisInterpolation(Banded(m), Banded(m.t().contiguous())) for m in across)
    in_columns = along_x is None and along_y is None
    if in_columns:
        slots = slots[:, columns]
    slots = slots.reshape(-1) + grid.first_row[level]
    shape = (len(keys[2]), len(keys[1]), len(keys[0]))
    return _BoxLevel((along_x, along_y), shape, TableRows(slots), in_columns), along_z


def _slabs(depth: int, columns: int, inside: Tensor, begin: int, along_z: Sequence[Tensor | None]) -> Iterator[_Slab]:
    """A box's slabs from the top down: `inside` (A,) ascending as in `_Slab`, but z counts from the box."""
    planes = -(-depth // max(1, round(depth * columns / _SLAB)))
    for top in range(0, depth, planes):
        bottom = min(top + planes, depth)
        first, last = torch.searchsorted(inside, torch.tensor([top * columns, bottom * columns])).tolist()
        levels = tuple(band_of(matrix, top, bottom) for matrix in along_z)
        yield _Slab(bottom - top, inside[first:last] - top * columns, begin + first, begin + last, levels)
