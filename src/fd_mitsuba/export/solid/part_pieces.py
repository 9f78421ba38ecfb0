"""The pieces that a part falls into on the tetrahedral grid: bridged, left out, filled before a surface is made.

Vertices are connected along the grid's edges, so pieces here are exactly those of the extracted surface. Two numbers
stand at each vertex of the grid, and one is not the other:

    pieces, `Labels`              named parts, `Owners`         `_part_shares`: (parts, 1 + pieces)
    what is connected, from 1     what the scene calls it,              -    1    2    3
    on; 0 where nothing is        from 0 on, everywhere           0     .   .99   0   .01   <- 3 is a stray island,
                                                                  1     .    0    1    0       2 is all of part 1
      . . 3 . . . . . .             0 0 0 0 0 1 1 1 1
      . . . . . . . . .             0 0 0 0 0 1 1 1 1           Arrays over the grid are (z, y, x); tensors (count,)
      . 1 1 1 . 2 2 . .             0 0 0 0 0 1 1 1 1           hold the same values in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NewType

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from fd_mitsuba.extraction.pieces import label_pieces
from fd_mitsuba.extraction.tet_grid import TetGrid

Labels = NewType("Labels", np.ndarray)
"""(z, y, x) the number of each vertex's piece, from 1 on; 0 outside of all."""
Owners = NewType("Owners", np.ndarray)
"""(z, y, x) the number of the named part that each vertex belongs to, from 0 on."""

ISLAND_SHARE = 0.01
"""A piece with less than this share of its named part's volume is a stray island."""

BRIDGE_REACH = 0.1
"""The part swells by at most this, canonical units, to reach the base; what stays farther away is meant to float."""


@dataclass(frozen=True)
class Bridge:
    """A piece that swells to reach the base; see `bridge_gaps`.

    Attributes:
        gap: what was between them, canonical units.
        swelling: by how much the piece grows at most, canonical units.
        own: (z, y, x) bool, the vertices of the grid that are nearer to this piece than to any other.
    """

    gap: float
    swelling: float
    own: np.ndarray


def bridge_weight(sdf_base: Tensor, bridge: Bridge) -> Tensor:
    """The share (N,) of the swelling that a point takes part in: all of it up to the gap's width from the base."""
    return ((bridge.gap + 2 * bridge.swelling + sdf_base) / (2 * bridge.swelling)).clamp(0, 1)


def keep_large(inside: np.ndarray, volume: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """`inside` (z, y, x) without stray islands, and how many islands each named part lost.

    A piece counts by the volume of the part in it: what is fillet only has none, goes too, and is not counted.

    Args:
        inside: (z, y, x) bool.
        volume: (z, y, x) how much of the part is around a vertex.
        owner: (z, y, x) number of the named part that a vertex belongs to.
    """
    label, count = _labels(inside)
    shares = _part_shares(label, count, volume, Owners(owner))
    stray = shares.max(axis=0) < ISLAND_SHARE
    stray[0] = True
    removed = [int(((shares.argmax(axis=0) == i) & stray & (shares[i] > 0))[1:].sum()) for i in range(len(shares))]
    return inside & ~stray[label], removed


def fill_pockets(inside: np.ndarray, fillable: np.ndarray) -> np.ndarray:
    """`inside` (z, y, x) with every enclosed void filled that is `fillable` throughout."""
    label, count = _labels(~inside)
    border = np.ones(label.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    keep = np.zeros(count + 1, dtype=bool)
    keep[label[border | ~fillable]] = True
    keep[0] = True
    return inside | ~keep[label]


def bridge_gaps(
    grid: TetGrid, sdf_base: Tensor, sdf_part: Tensor, owner: Tensor, inside_of: Callable[[Tensor], Tensor]
) -> tuple[Tensor, list[Bridge]]:
    """`sdf_part` (count,) swollen towards the base where a piece ends just before it, and how it was done.

    A piece is joined to the base if it has a vertex inside it. One that is not, though it is large, swells near its
    end: with gap g to the base and swelling a, its signed distance grows by a clamp((g + 2 a + sdf_base) / 2 a, 0, 1),
    all of a up to a distance g from the base and nothing beyond g + 2 a. That grows half as fast as the distance falls,
    so the part's surface stays one. The smallest a that joins is taken, in steps of half a cell, and half a cell more,
    so that the joint is no mere thread. A piece that would need more than `BRIDGE_REACH` stays as it was.

    Args:
        inside_of: the solid (count,) bool that belongs to a `sdf_part`.
    """
    inside = inside_of(sdf_part)
    label, count = _labels(_lattice(grid, inside))
    owners = Owners(_lattice(grid, owner))
    large = _part_shares(label, count, part_volume(grid, sdf_part), owners).max(axis=0) >= ISLAND_SHARE
    floating = [piece for piece in range(1, count + 1) if large[piece] and not _joined(label == piece, sdf_base)]
    if not floating:
        return sdf_part, []
    nearest: Any = ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
    nearest_piece = label[tuple(nearest)]
    bridged, half_cell = sdf_part, grid.spacing / 2
    bridges: list[Bridge] = []
    # Outside the part its sdf is what the losses left there, often far below the true one: no swelling gets over it.
    true = torch.maximum(sdf_part, -distance_to(grid, sdf_part > 0))
    for piece in floating:
        own, core = nearest_piece == piece, torch.from_numpy(label == piece).view(-1)
        seed = int(torch.where(core, sdf_part, -torch.inf).argmax())
        gap = float(-sdf_base[core].max())
        for step in range(1, int((BRIDGE_REACH - half_cell) / half_cell) + 1):
            trial = Bridge(gap, step * half_cell, own)
            if not _reaches(grid, inside_of(_swollen(sdf_part, true, sdf_base, trial)), seed, sdf_base):
                continue
            bridges.append(Bridge(gap, (step + 1) * half_cell, own))
            bridged = torch.maximum(bridged, _swollen(sdf_part, true, sdf_base, bridges[-1]))
            break
    return bridged, bridges


def distance_to(grid: TetGrid, marked: Tensor) -> Tensor:
    """Distance (count,) of every vertex of the grid to the nearest marked one, canonical units; infinite without."""
    if not bool(marked.any()):
        return torch.full((grid.count,), torch.inf)
    distance = ndimage.distance_transform_edt(~marked.view((grid.side,) * 3).numpy(), sampling=grid.spacing)
    return torch.from_numpy(distance).view(-1).float()


def _swollen(sdf_part: Tensor, true: Tensor, sdf_base: Tensor, bridge: Bridge) -> Tensor:
    weight = bridge_weight(sdf_base, bridge) * torch.from_numpy(bridge.own).view(-1)
    return torch.where(weight > 0, torch.maximum(sdf_part, true + bridge.swelling * weight), sdf_part)


def _reaches(grid: TetGrid, inside: Tensor, seed: int, sdf_base: Tensor) -> bool:
    label, _ = _labels(_lattice(grid, inside))
    return _joined(label == label.reshape(-1)[seed], sdf_base)


def _joined(piece: np.ndarray, sdf_base: Tensor) -> bool:
    return bool((sdf_base.numpy()[piece.reshape(-1)] > 0).any())


def _labels(marked: np.ndarray) -> tuple[Labels, int]:
    label, count = label_pieces(marked)
    return Labels(label), count


def _lattice(grid: TetGrid, values: Tensor) -> np.ndarray:
    """Values (count,) as (z, y, x)."""
    return values.view((grid.side,) * 3).numpy()


def _part_shares(label: Labels, count: int, volume: np.ndarray, owner: Owners) -> np.ndarray:
    """Which share of a named part's volume lies in a piece, (parts, 1 + count); the first column is not used."""
    shares = np.zeros((int(owner.max()) + 1, count + 1))
    for number, row in enumerate(shares):
        row += np.bincount(label.reshape(-1), weights=(volume * (owner == number)).reshape(-1), minlength=count + 1)
        row[0] = 0.0
        row /= max(row.sum(), 1e-30)
    return shares


def part_volume(grid: TetGrid, sdf_part: Tensor) -> np.ndarray:
    """How much of a cell around each vertex (z, y, x) the part fills, at about."""
    volume = (0.5 + sdf_part / grid.spacing).clamp(0, 1) * (sdf_part > 0)
    return _lattice(grid, volume)
