"""Where a piece of the part has come loose from the object, and the vertices along which it should hang on.

Stalks and stems are thinner than a pixel of the guidance's pictures, so its gradient wears them away, and what they
carry floats. This looks at one state of the part alone: a run that is resumed goes on as if it had not stopped.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from fd_mitsuba.extraction.lattice_box import LatticeBox
from fd_mitsuba.extraction.pieces import label_pieces
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.index_spaces import GridVertices

LEAST_SHARE = 0.02
"""Pieces with less than this share of the part's vertices are left alone; the export drops the smallest."""
THIN = 0.25
"""What is less deep than this, in cells, counts as worn away already: a stalk is held before it breaks."""


class Tethers:
    """Looks for loose pieces of a part at the grid's vertices.

    Args:
        grid: the grid.
        sdf_base: (count,) base sdf at its vertices, inside positive, canonical units.
        room: (count,) bool, where the part may grow.
        active_index: (A,) int64 vertices at which the part exists.
    """

    def __init__(self, grid: TetGrid, sdf_base: Tensor, room: Tensor, active_index: GridVertices) -> None:
        self._box = LatticeBox(grid, active_index)
        self._place = self._box.local(active_index)
        self._base = self._box.cut(sdf_base > 0).numpy()
        reachable = torch.zeros(grid.count, dtype=torch.bool)
        reachable[active_index] = room[active_index]
        self._room = self._box.cut(reachable).numpy()

    def find(self, deeper: Tensor) -> GridVertices:
        """The vertices (T,) int64 of `tether_vertices`. No gradients.

        Args:
            deeper: (A,) bool, where the part is deeper than `THIN` cells, at the active vertices.
        """
        part = torch.zeros(len(self._box.vertices), dtype=torch.bool)
        part[self._place] = deeper
        found = tether_vertices(part.view(self._box.shape).numpy(), self._base, self._room)
        return GridVertices(self._box.vertices[torch.from_numpy(found)])


def tether_vertices(part: np.ndarray, base: np.ndarray, room: np.ndarray) -> np.ndarray:
    """The vertices (T,) int64, flat and ascending, between loose pieces and the object.

    A piece is loose if it does not hang on the base, by itself or by other pieces. The vertices are those along the
    shortest straight line from it to what does. Where that leaves the room, the piece is meant to float.

    Args:
        part, base: (z, y, x) bool, what is inside of either.
        room: (z, y, x) bool, where the part may grow.
    """
    label, count = label_pieces(part | base)
    held = np.zeros(count + 1, dtype=bool)
    held[label[base]] = True
    sizes = np.bincount(label[part], minlength=count + 1)
    loose = np.flatnonzero(~held & (sizes >= max(1.0, LEAST_SHARE * part.sum())))
    if not len(loose) or not held.any():
        return np.zeros(0, dtype=np.int64)
    found: Any = ndimage.distance_transform_edt(~held[label], return_indices=True)
    distance, nearest = found
    marked = np.zeros(part.shape, dtype=bool)
    for number in loose:
        piece = np.argwhere(label == number)
        away = distance[tuple(piece.T)]
        ends = piece[away == away.min()]
        start = ends[np.abs(ends - ends.mean(axis=0)).sum(axis=1).argmin()]
        line = tuple(_staircase(start, nearest[(slice(None), *start)]).T)
        if (room | base | part)[line].all():
            marked[line] = True
    return np.flatnonzero(marked & room & ~base)


def _staircase(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The vertices (N, 3) along a straight line, one step along one axis after the other: an edge joins each two."""
    way = end - start
    axis = np.repeat(np.arange(3), np.abs(way))
    when = np.concatenate([(np.arange(count) + 0.5) / max(count, 1) for count in np.abs(way)])
    steps = np.sign(way) * np.eye(3, dtype=np.int64)
    return start + np.concatenate([np.zeros((1, 3), np.int64), steps[axis[np.argsort(when, kind="stable")]].cumsum(0)])
