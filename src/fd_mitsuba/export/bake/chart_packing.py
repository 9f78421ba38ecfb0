"""Charts packed into a square as large as they fit, each turned by whole quarters as suits it, never mirrored.

On a grid of cells a few texels wide: a chart's mask, widened by half a gutter, is laid where it overlaps no other. One
correlation by Fourier transform says that of all places at once; of these the first that is free is taken, row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_CELLS = 256
_STARTS_AT, _STEP, _TRIES = 0.745, 0.95, 8
"""The share of the square that is tried first, what a try that does not fit is scaled by, and how often."""
_FINE_STEP, _MORE_TRIES, _ORDERS = 0.98, 3, 3
"""What has fitted is scaled up by, how often, and in how many orders the charts are laid for it."""


@dataclass(frozen=True)
class _Shape:
    mask: np.ndarray
    """(h, w) bool, the cells that it needs, gutter included."""
    low: np.ndarray
    """(2,) where the mask's corner is in the chart's own frame, in cells."""


def packed_charts(
    flat: np.ndarray, faces: np.ndarray, chart: np.ndarray, texture_size: int, padding: int
) -> np.ndarray | None:
    """Places (V, 2) in [0, 1] for charts of places `flat` (V, 2), all to one scale; None where they do not fit.

    Args:
        faces: (F, 3).
        chart: (V,) the chart of each vertex, counted from 0.
        texture_size: texels a side.
        padding: texels between two charts, and half as many to the square's edge.
    """
    cells = min(_CELLS, texture_size)
    gutter = padding / 2 * cells / texture_size
    corners = flat[faces]
    sides = corners[:, 1:] - corners[:, :1]
    areas = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / 2
    of_face = chart[faces[:, 0]]
    area = np.bincount(of_face, areas)
    scale = cells * np.sqrt(_STARTS_AT / max(areas.sum(), 1e-30))

    def laid(scale: float, orders: int) -> np.ndarray | None:
        shapes = _shapes(flat * scale, faces, of_face, len(area), gutter)
        places = _laid_in_some_order(shapes, area, cells, orders)
        if places is None:
            return None
        made = np.empty_like(flat)
        for number, (quarter, at) in enumerate(places):
            own = chart == number
            made[own] = _turned(flat[own] * scale - shapes[number].low, shapes[number].mask.shape, quarter) + at
        return made / cells

    best = None
    for _ in range(_TRIES):
        best = laid(scale, 1)
        if best is not None:
            break
        scale *= np.sqrt(_STEP)
    for _ in range(_MORE_TRIES if best is not None else 0):
        scale /= np.sqrt(_FINE_STEP)
        larger = laid(scale, _ORDERS)
        if larger is None:
            break
        best = larger
    return best


def _shapes(flat: np.ndarray, faces: np.ndarray, of_face: np.ndarray, count: int, gutter: float) -> list[_Shape]:
    from scipy.ndimage import distance_transform_edt  # imported late: whoever only names formats needs none

    points, owner = _covering(flat, faces, of_face)
    reach = int(np.ceil(gutter + 0.5))
    shapes = []
    order = np.argsort(owner, kind="stable")
    cuts = np.searchsorted(owner[order], np.arange(count + 1))
    for number in range(count):
        own = points[order[cuts[number] : cuts[number + 1]]]
        low = np.floor(own.min(axis=0)) - reach
        index = (own - low).astype(int)
        width, height = index.max(axis=0) + 1 + reach
        empty = np.ones((height, width), dtype=bool)
        empty[index[:, 1], index[:, 0]] = False
        # A cell's middle is up to 0.71 cells from a point in it; half a cell each is made up for by the other chart's.
        away: Any = distance_transform_edt(empty)
        shapes.append(_Shape(away <= gutter + 0.75, low))
    return shapes


def _covering(flat: np.ndarray, faces: np.ndarray, of_face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on all faces, half a cell apart at most, and the chart of each."""
    corners = flat[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(np.ceil(2 * longest), 1).astype(int)
    points, owners = [], []
    for number in np.unique(parts):
        chosen = parts == number
        grid = np.array([(i, j, number - i - j) for i in range(number + 1) for j in range(number + 1 - i)]) / number
        found = np.einsum("pk,fkx->fpx", grid, corners[chosen])
        points.append(found.reshape(-1, 2))
        owners.append(np.repeat(of_face[chosen], len(grid)))
    return np.concatenate(points), np.concatenate(owners)


def _laid_in_some_order(
    shapes: list[_Shape], area: np.ndarray, cells: int, orders: int
) -> list[tuple[int, np.ndarray]] | None:
    """As `_laid`, the largest charts first, or else the longest, or those that take up the largest rectangles."""
    sides = np.array([shape.mask.shape for shape in shapes])
    for size in (area, sides.max(axis=1), sides.prod(axis=1))[:orders]:
        places = _laid(shapes, np.argsort(-size, kind="stable"), cells)
        if places is not None:
            return places
    return None


def _laid(shapes: list[_Shape], order: np.ndarray, cells: int) -> list[tuple[int, np.ndarray]] | None:
    """Per chart its quarter turns and the cell of its mask's corner; None where they do not fit."""
    from scipy import fft

    taken = np.zeros((cells, cells), dtype=np.float32)
    places: list[tuple[int, np.ndarray]] = [(0, np.zeros(2))] * len(shapes)
    for number in order:
        spectrum: Any = fft.rfft2(taken)
        best = None
        for quarter in range(4):
            mask = _turned_mask(shapes[number].mask, quarter)
            height, width = mask.shape
            if height > cells or width > cells:
                continue
            other: Any = fft.rfft2(mask.astype(np.float32), taken.shape)
            overlap: Any = fft.irfft2(spectrum * np.conj(other), taken.shape)
            free = overlap[: cells - height + 1, : cells - width + 1] < 0.5
            if not free.any():
                continue
            y, x = np.nonzero(free)
            far = (y + height) * 4096 + x + width
            at = int(np.argmin(far))
            if best is None or far[at] < best[0]:
                best = int(far[at]), quarter, np.array([x[at], y[at]]), mask
        if best is None:
            return None
        _, quarter, (x, y), mask = best
        taken[y : y + mask.shape[0], x : x + mask.shape[1]] += mask
        places[number] = quarter, np.array([x, y], dtype=float)
    return places


def _turned_mask(mask: np.ndarray, quarter: int) -> np.ndarray:
    for _ in range(quarter):
        mask = mask.T[:, ::-1]
    return mask


def _turned(points: np.ndarray, shape: tuple[int, int], quarter: int) -> np.ndarray:
    """Points (N, 2) in a box of (height, width), turned with it by quarters, counter-clockwise."""
    height, width = shape
    for _ in range(quarter):
        points = np.stack([height - points[:, 1], points[:, 0]], axis=1)
        height, width = width, height
    return points


def likely_density(flat: np.ndarray, faces: np.ndarray, texture_size: int) -> float:
    """Texels a unit of length, if 60 % of the texture is covered."""
    corners = flat[faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = float(np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum() / 2)
    return texture_size * float(np.sqrt(0.6 / max(area, 1e-30)))
