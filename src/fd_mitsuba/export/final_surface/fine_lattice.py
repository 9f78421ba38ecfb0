"""A function's zero set on a lattice several times finer than the training's, evaluated around the zero set only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from fd_mitsuba.extraction.lattice_box import touched_cells
from fd_mitsuba.extraction.marching_tets import crossing_faces, crossing_fraction, edge_ends
from fd_mitsuba.extraction.tet_grid import TetGrid

_NEAR_CELLS = 0.35
"""Cells without a change of sign are looked into, too, where the coarse values come as near to 0, in cells."""
_MOST_GROWTH = 12


@dataclass(frozen=True)
class FineLattice:
    """Values on a box of a lattice, exact around their zero set, of the right sign elsewhere.

    Attributes:
        values: (z, y, x) float32, inside positive.
        origin: (3,) canonical position of the first vertex.
        spacing: canonical units.
        vertices: the coarse lattice's vertices that it covers, along z, y, x.
        factor: how many times finer it is.
    """

    values: np.ndarray
    origin: np.ndarray
    spacing: float
    vertices: tuple[slice, slice, slice]
    factor: int

    def between(self, coarse: np.ndarray) -> np.ndarray:
        """Values (z, y, x) of the coarse lattice, interpolated."""
        return _upsampled(coarse[self.vertices].astype(np.float32), self.factor)

    def nearest(self, coarse: np.ndarray) -> np.ndarray:
        """The values (z, y, x) at the nearest vertices of the coarse lattice."""
        places = [(np.arange(side) + self.factor // 2) // self.factor for side in self.values.shape]
        return coarse[self.vertices][np.ix_(*places)]

    def surface(self, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) float64 and faces (F, 3) around `inside` (z, y, x), closed within the box.

        Vertices lie where the values cross 0, or in the middle of an edge that they do not cross.
        """
        shape = inside.shape
        edges, faces = crossing_faces(torch.from_numpy(np.ascontiguousarray(inside)))
        lower, upper = (ends.numpy() for ends in edge_ends(edges, shape))
        marks, values = inside.reshape(-1), self.values.reshape(-1)
        inner, outer = np.where(marks[lower], lower, upper), np.where(marks[lower], upper, lower)
        first, second = torch.from_numpy(values[inner]), torch.from_numpy(values[outer])
        crossed = (first > 0) & (second <= 0)
        fraction = torch.where(crossed, crossing_fraction(first, second, self.spacing), torch.tensor(0.5)).double()
        start, end = self._positions(inner), self._positions(outer)
        return start + fraction.numpy()[:, None] * (end - start), faces.numpy()

    def _positions(self, index: np.ndarray) -> np.ndarray:
        z, y, x = np.unravel_index(index, self.values.shape)
        return self.origin + self.spacing * np.stack([x, y, z], axis=1)


def refined(
    grid: TetGrid, coarse: np.ndarray, function: Callable[[np.ndarray], np.ndarray], factor: int
) -> FineLattice | None:
    """The function on a lattice `factor` times finer than `grid`; None where the coarse values are positive nowhere.

    Evaluates the cells of `grid` around changes of sign, and further ones as long as the zero set leads there.

    Args:
        coarse: (z, y, x) values of about the same function at the grid's vertices.
        function: points (N, 3), canonical -> values (N,), inside positive.
    """
    signs = torch.from_numpy(coarse > 0)
    near = touched_cells(signs) & touched_cells(~signs)
    near |= touched_cells(torch.from_numpy(np.abs(coarse) < _NEAR_CELLS * grid.spacing))
    if not bool(near.any()):
        return None
    active = ndimage.binary_dilation(near.numpy(), np.ones((3, 3, 3)))
    bounds = [slice(max(s.start - 2, 0), s.stop + 2) for s in ndimage.find_objects(active.astype(np.int8))[0]]
    active = active[tuple(bounds)].copy()
    z, y, x = (slice(b.start, b.start + side + 1) for b, side in zip(bounds, active.shape, strict=True))
    vertices = (z, y, x)
    values = _upsampled(coarse[vertices].astype(np.float32), factor)
    first = np.array([vertices[axis].start for axis in (2, 1, 0)])
    made = FineLattice(values, grid.axis.numpy()[first], grid.spacing / factor, vertices, factor)
    known = np.zeros(values.shape, dtype=bool)
    for _ in range(_MOST_GROWTH):
        wanted = _vertices_of(active, factor) & ~known
        index = np.flatnonzero(wanted)
        values.reshape(-1)[index] = function(made._positions(index))
        known |= wanted
        grown = active | _cells_to_add(values > 0, known, factor)
        if (grown == active).all():
            break
        active = grown
    for axis in range(3):  # whatever it is, it ends within the box
        for end in (0, -1):
            np.moveaxis(values, axis, 0)[end] = np.minimum(np.moveaxis(values, axis, 0)[end], -1e-6)
    return made


def _cells_to_add(inside: np.ndarray, known: np.ndarray, factor: int) -> np.ndarray:
    """The coarse cells in which a fine cell has both signs and a vertex that was not evaluated."""
    signs = torch.from_numpy(inside)
    open_ends = touched_cells(signs) & touched_cells(~signs) & touched_cells(torch.from_numpy(~known))
    shape = tuple(side // factor for side in open_ends.shape)
    blocks = open_ends.numpy().reshape(shape[0], factor, shape[1], factor, shape[2], factor)
    return np.any(blocks, axis=(1, 3, 5))


def _vertices_of(cells: np.ndarray, factor: int) -> np.ndarray:
    """The fine vertices (z, y, x) in or on marked coarse cells."""
    fine = np.kron(cells, np.ones((factor,) * 3, dtype=bool))
    marks = np.zeros(tuple(side + 1 for side in fine.shape), dtype=bool)
    for z in (0, 1):
        for y in (0, 1):
            for x in (0, 1):
                marks[z : z + fine.shape[0], y : y + fine.shape[1], x : x + fine.shape[2]] |= fine
    return marks


def _upsampled(values: np.ndarray, factor: int) -> np.ndarray:
    """Trilinear values between those of a lattice, `factor` times as many."""
    for axis in range(3):
        values = np.moveaxis(values, axis, 0)
        weight = (np.arange(factor, dtype=np.float32) / factor)[:, None, None]
        between = values[:-1, None] + weight * (values[1:, None] - values[:-1, None])
        values = np.concatenate([between.reshape(-1, *values.shape[1:]), values[-1:]])
        values = np.moveaxis(values, 0, axis)
    return np.ascontiguousarray(values)
