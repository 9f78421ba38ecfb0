"""Trilinear interpolation along one axis of a lattice: a constant matrix, most of which is zeros."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from fd_mitsuba.fields.hash_grid import HashGrid

_BAND_ROWS = 24
"""Of a band of a matrix along x or y, at about."""
_SNAP = 1e-9
"""Coordinates this close to a lattice plane lie on it, in cells; they need one vertex instead of two."""


def axis_matrix(grid: HashGrid, level: int, coordinate: Tensor) -> tuple[Tensor, Tensor]:
    """Linear interpolation as a matrix (sites, vertices) and the lattice vertices (int64) that it reads."""
    resolution = grid.resolutions[level]
    cell, fraction = grid.split(level, coordinate.double())
    at_upper = fraction > 1 - _SNAP
    cell, fraction = cell + at_upper.long(), torch.where(at_upper | (fraction < _SNAP), 0.0, fraction)
    upper = (cell + 1).clamp(max=resolution)
    vertices = torch.cat([cell, upper[fraction > 0]]).unique()
    matrix = torch.zeros(len(coordinate), len(vertices), dtype=torch.float64)
    sites = torch.arange(len(coordinate))
    matrix.index_put_((sites, torch.searchsorted(vertices, cell)), 1 - fraction)
    reads = fraction > 0
    matrix.index_put_((sites[reads], torch.searchsorted(vertices, upper[reads])), fraction[reads])
    return matrix, vertices


def band_of(matrix: Tensor | None, top: int, bottom: int) -> tuple[int, int, Tensor | None]:
    """The columns of these rows that are not all 0, as first, one after the last, and what is between."""
    return (top, bottom, None) if matrix is None else _band(matrix, top, bottom)


def _band(matrix: Tensor, top: int, bottom: int) -> tuple[int, int, Tensor]:
    used = (matrix[top:bottom] != 0).any(dim=0).nonzero()[:, 0]
    first, last = int(used[0]), int(used[-1]) + 1
    return first, last, matrix[top:bottom, first:last].contiguous()


class Banded:
    """A constant matrix (rows, columns) whose entries other than 0 lie along a diagonal, as bands of rows."""

    def __init__(self, matrix: Tensor) -> None:
        count = max(1, round(len(matrix) / _BAND_ROWS))
        cuts = [len(matrix) * number // count for number in range(count + 1)]
        self._bands = [_band(matrix, top, bottom) for top, bottom in pairwise(cuts)]

    def from_left(self, values: Tensor) -> Tensor:
        """The matrix times each of values (N, columns, K)."""
        pieces = [
            torch.bmm(band.expand(len(values), -1, -1), values[:, first:last]) for first, last, band in self._bands
        ]
        return pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim=1)

    def from_right(self, values: Tensor) -> Tensor:
        """Values (N, columns) times the transposed matrix."""
        pieces = [torch.mm(values[:, first:last], band.t()) for first, last, band in self._bands]
        return pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim=1)


@dataclass(frozen=True)
class AxisInterpolation:
    """Interpolation along an axis, and its transpose."""

    to_sites: Banded
    to_lattice: Banded
