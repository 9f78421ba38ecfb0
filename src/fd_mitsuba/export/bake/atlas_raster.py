"""Which face lies under each sample of a texture, also a little beyond the charts' edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_PAIRS_AT_ONCE = 1 << 20
_NOTHING = -np.inf


@dataclass(frozen=True)
class AtlasRaster:
    """A square picture of samples, row 0 at v = 0.

    Attributes:
        face: (S, S) int32, the face that covers the sample or is nearest to it; -1 where none is within reach.
        beyond: (S, S) float32, how far the sample lies outside that face in samples, 0 inside.
    """

    face: np.ndarray
    beyond: np.ndarray


def rasterise(uv: np.ndarray, faces: np.ndarray, size: int, reach: float) -> AtlasRaster:
    """The faces under the centres of `size` x `size` samples.

    Args:
        uv: (V, 2) in [0, 1], split at the seams.
        faces: (F, 3); faces without area in the atlas cover nothing.
        reach: samples outside all faces still belong to the nearest one within this distance, in samples.
    """
    corners = np.asarray(uv, dtype=np.float64)[faces] * size - 0.5  # sample (column, row) has its centre at integers
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice_area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    usable = np.abs(twice_area) > 1e-9
    margin = np.where(_at_edge(faces[usable], len(uv)), reach, 0.0)
    corners = np.where((twice_area > 0)[:, None, None], corners, corners[:, ::-1])[usable]
    numbers = np.nonzero(usable)[0].astype(np.int32)
    low = np.clip(np.ceil(corners.min(axis=1) - margin[:, None]), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) + margin[:, None]) + 1, 0, size).astype(np.int64)
    extent = np.maximum(high - low, 0)
    pairs = extent[:, 0] * extent[:, 1]
    score = np.full(size * size, _NOTHING, dtype=np.float32)
    face = np.full(size * size, -1, dtype=np.int32)
    for start, stop in _runs(pairs):
        count = pairs[start:stop]
        owner = np.repeat(np.arange(start, stop), count)
        place = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        column = low[owner, 0] + place % extent[owner, 0]
        row = low[owner, 1] + place // extent[owner, 0]
        distance = _outside(corners, owner, column.astype(np.float64), row.astype(np.float64))
        near = distance <= margin[owner]
        value, index = -distance[near].astype(np.float32), (row * size + column)[near]
        np.maximum.at(score, index, value)
        winner = value == score[index]
        face[index[winner]] = numbers[owner[near][winner]]
    beyond = np.where(face >= 0, -score, 0).astype(np.float32)
    return AtlasRaster(face.reshape(size, size), beyond.reshape(size, size))


def weights_at(corners: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric weights (N, 3) of 2D points (N, 2) in triangles (N, 3, 2), and those of the nearest point inside."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    b = (offset[:, 0] * second[:, 1] - offset[:, 1] * second[:, 0]) / area
    c = (first[:, 0] * offset[:, 1] - first[:, 1] * offset[:, 0]) / area
    free = np.stack([1 - b - c, b, c], axis=1)
    nearest, least = free.copy(), np.full(len(points), np.inf)
    outside = np.any(free < 0, axis=1)
    for k in range(3):
        a, z = corners[:, k], corners[:, (k + 1) % 3]
        edge = z - a
        along = np.clip(_dot(points - a, edge) / np.maximum(_dot(edge, edge), 1e-30), 0, 1)
        squared = np.sum((points - a - along[:, None] * edge) ** 2, axis=1)
        better = outside & (squared < least)
        least[better] = squared[better]
        nearest[better] = 0
        nearest[better, k], nearest[better, (k + 1) % 3] = 1 - along[better], along[better]
    return free, nearest


def _outside(corners: np.ndarray, owner: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance of points to triangles that run counter-clockwise in (column, row), 0 inside."""
    inside = np.ones(len(x), dtype=bool)
    squared = np.full(len(x), np.inf)
    for k in range(3):
        start, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        edge_x, edge_y = edge[owner, 0], edge[owner, 1]
        dx, dy = x - start[owner, 0], y - start[owner, 1]
        inside &= edge_x * dy - edge_y * dx >= -1e-9
        length = np.maximum(edge_x * edge_x + edge_y * edge_y, 1e-30)
        along = np.clip((dx * edge_x + dy * edge_y) / length, 0, 1)
        squared = np.minimum(squared, (dx - along * edge_x) ** 2 + (dy - along * edge_y) ** 2)
    return np.where(inside, 0.0, np.sqrt(squared))


def _at_edge(faces: np.ndarray, count: int) -> np.ndarray:
    """Faces (F, 3) with a corner at the edge of their chart: the only ones that anything beyond can be nearest to."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    keys, times = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    single = keys[times == 1]
    border = np.zeros(count, dtype=bool)
    border[single // count] = border[single % count] = True
    return np.any(border[faces], axis=1)


def _runs(pairs: np.ndarray) -> list[tuple[int, int]]:
    """Consecutive runs of faces with about `_PAIRS_AT_ONCE` pairs each."""
    batch = (np.cumsum(pairs) - pairs) // _PAIRS_AT_ONCE
    bounds = np.concatenate([[0], np.nonzero(np.diff(batch))[0] + 1, [len(pairs)]])
    return [(int(a), int(b)) for a, b in zip(bounds[:-1], bounds[1:], strict=True) if b > a]


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", first, second)
