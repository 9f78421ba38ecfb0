"""A multi-resolution hash grid: trilinear features of learned vertices, coarse levels stored densely, fine ones hashed.

The encoding is Instant-NGP's (Müller et al. 2022; the paper's supplement "Geometry Learning" uses it). Every level is
a cubic lattice over the same cube. A lattice vertex finds its table row by combining one key per axis,
`slot = key_x ^ key_y ^ key_z`, masked to the level's table:

* a level whose vertices fit has keys that occupy disjoint bits, so every vertex owns a row;
* a finer level multiplies the axes by large odd numbers, so several vertices may share a row.

`HashGrid.forward` is the plain version. `fields.lattice_sites` evaluates the same function at the fixed vertices of a
tetrahedral grid, where keys and weights can be computed once.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fd_mitsuba.conventions import GRID_HALF_EXTENT

_AXIS_FACTORS = (1, 2654435761, 805459861)
_INITIAL_RANGE = 1e-4


class HashGrid(nn.Module):
    """Features of points, learned at the vertices of `levels` lattices between two resolutions.

    Args:
        levels: number of lattices; their resolutions grow geometrically.
        features: learned values per vertex and level.
        base_resolution: cells a side of the coarsest lattice.
        finest_resolution: cells a side of the finest lattice.
        log2_table: a level holds at most 2^log2_table rows.
        seed: decides the initial rows, uniform in [-1e-4, 1e-4].
        half_extent: the lattices cover [-half_extent, half_extent]^3 of the canonical frame.
    """

    def __init__(
        self,
        levels: int = 10,
        features: int = 2,
        base_resolution: int = 8,
        finest_resolution: int = 128,
        log2_table: int = 15,
        seed: int = 0,
        half_extent: float = GRID_HALF_EXTENT,
    ) -> None:
        super().__init__()
        self.levels, self.features = levels, features
        self.half_extent = half_extent
        growth = (finest_resolution / base_resolution) ** (1 / max(levels - 1, 1))
        self.resolutions = tuple(round(base_resolution * growth**level) for level in range(levels))
        self._bits = tuple(math.ceil(math.log2(resolution + 1)) for resolution in self.resolutions)
        self.rows = tuple(1 << min(3 * bits, log2_table) for bits in self._bits)
        self.first_row = tuple(sum(self.rows[:level]) for level in range(levels))
        generator = torch.Generator().manual_seed(seed)
        table = torch.rand(features, sum(self.rows), generator=generator, dtype=torch.float64)
        self.table = nn.Parameter(((2 * table - 1) * _INITIAL_RANGE).to(torch.get_default_dtype()))

    @property
    def width(self) -> int:
        """Features per point: levels times features."""
        return self.levels * self.features

    def is_dense(self, level: int) -> bool:
        """Whether every vertex of the level owns a row (a side counts as the next power of two)."""
        return self.rows[level] == 1 << 3 * self._bits[level]

    def axis_key(self, level: int, axis: int, vertex: Tensor) -> Tensor:
        """One axis' share (int64, same shape) of the row of lattice vertices with that coordinate; combine with `^`."""
        if self.is_dense(level):
            return vertex << (axis * self._bits[level])
        return (vertex * _AXIS_FACTORS[axis]) & (self.rows[level] - 1)

    def split(self, level: int, coordinate: Tensor) -> tuple[Tensor, Tensor]:
        """The lattice cell (int64) that holds canonical coordinates and the position (float, [0, 1]) within it.

        Coordinates beyond the cube count as its border.
        """
        resolution = self.resolutions[level]
        scaled = ((coordinate / (2 * self.half_extent) + 0.5) * resolution).clamp(0, resolution)
        cell = scaled.detach().floor().clamp(max=resolution - 1)
        return cell.long(), scaled - cell

    def largest(self, table: Tensor) -> Tensor:
        """The largest magnitude (levels * features,) of each feature in a table of this layout: no point has more."""
        levels = table.split(self.rows, dim=1)
        return torch.cat([level.abs().amax(dim=1) for level in levels])  # ten times as fast as the maximum norm

    def forward(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N features"]:
        """The features (N, levels * features) at canonical positions (N, 3), level after level.

        Gradients flow to the table and, piecewise, to the positions.
        """
        return torch.cat([self._level_features(level, positions) for level in range(self.levels)], dim=1)

    def _level_features(self, level: int, positions: Tensor) -> Tensor:
        cell, fraction = self.split(level, positions)
        total = positions.new_zeros(self.features, len(positions))
        for corner in range(8):
            bits = [(corner >> axis) & 1 for axis in range(3)]
            keys = [self.axis_key(level, axis, cell[:, axis] + bits[axis]) for axis in range(3)]
            weights = [fraction[:, axis] if bits[axis] else 1 - fraction[:, axis] for axis in range(3)]
            row = self.first_row[level] + (keys[0] ^ keys[1] ^ keys[2])
            total = total + self.table[:, row] * (weights[0] * weights[1] * weights[2])
        return total.t()
