"""Charts whose own edges come too near to each other: nothing keeps the two sides of a notch apart but its width.

A packer leaves a gutter between charts, not within one. Where the flattening has all but closed a hole, filtering at
one side of it reads the other, which may lie far away on the surface. Faces at such places become charts of their own.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

_NEAR = 3.2
"""Filtering reads texels up to sqrt(2) away, and each is to be nearer to its own side: twice that, and half a texel's
own width."""
_APART = 1.5
"""How much farther than in the picture two places may be from each other on the surface, in texels."""
_STEP = 0.5
_ROUNDS = 6
_MOST = 0.02
"""Not more than this share of the faces: a texture that needs more is too coarse for the mesh anyway."""


def open_notches(
    vertices: np.ndarray, vertex_map: np.ndarray, faces: np.ndarray, flat: np.ndarray, density: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex map, faces and places with further splits, where two edges of one chart are too near to each other.

    Args:
        vertices: (V, 3), before any split.
        vertex_map: (S,), split vertex -> vertex.
        faces: (F, 3) in split vertices.
        flat: (S, 2), charts in the vertices' unit of length.
        density: texels a unit.
    """
    left = int(_MOST * len(faces))
    for _ in range(_ROUNDS):
        narrow = crowded(vertices[vertex_map], faces, flat, density)[:left, 0]
        if not len(narrow):
            break
        left -= len(narrow)
        fresh = faces[narrow].reshape(-1)
        apart = _in_a_row(flat[faces[narrow]], flat.max(axis=0) + 1 / density)
        faces = faces.copy()
        faces[narrow] = len(flat) + np.arange(len(fresh)).reshape(-1, 3)
        vertex_map, flat = np.concatenate([vertex_map, vertex_map[fresh]]), np.concatenate([flat, apart.reshape(-1, 2)])
        used, faces = np.unique(faces, return_inverse=True)
        faces, vertex_map, flat = faces.reshape(-1, 3), vertex_map[used], flat[used]
    return vertex_map, faces, flat


def _in_a_row(triangles: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The triangles (N, 3, 2) beside each other from `start` (2,) on: xatlas joins again what shares a place."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    width = 1.1 * (high - low)[:, 0]
    to = np.stack([start[0] + np.cumsum(width) - width, np.full(len(triangles), start[1])], axis=1)
    return triangles + (to - low)[:, None]


def charts_of(faces: np.ndarray, count: int) -> np.ndarray:
    """The chart (count,) that each vertex belongs to: what faces join."""
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def crowded(points: np.ndarray, faces: np.ndarray, flat: np.ndarray, density: float) -> np.ndarray:
    """Faces (N, 2) at both sides of each place that is too narrow, the worst first.

    The arguments are those of `open_notches`.
    """
    owner, places, where = _edge_samples(points, faces, flat, density)
    from scipy.spatial import KDTree  # imported late: whoever only names formats needs none

    pairs = KDTree(places).query_pairs(_NEAR, output_type="ndarray")
    chart = charts_of(faces, len(flat))[faces[:, 0]][owner]
    pairs = pairs[(chart[pairs[:, 0]] == chart[pairs[:, 1]]) & (owner[pairs[:, 0]] != owner[pairs[:, 1]])]
    one, other = pairs.T
    excess = np.linalg.norm(where[one] - where[other], axis=1) - np.linalg.norm(places[one] - places[other], axis=1)
    bad = np.argsort(-excess, kind="stable")[: int((excess > _APART).sum())]
    chosen: dict[int, int] = {}
    for a, b in np.sort(owner[pairs[bad]], axis=1).tolist():
        if a not in chosen and b not in chosen:
            chosen[a] = b
    return np.array(list(chosen.items()), dtype=np.int64).reshape(-1, 2)


def _edge_samples(
    points: np.ndarray, faces: np.ndarray, flat: np.ndarray, density: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Along the charts' edges: the face, the place in the picture and that on the surface, both in texels."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = np.sort(edges, axis=1)
    _, index, times = np.unique(keys[:, 0] * len(flat) + keys[:, 1], return_index=True, return_counts=True)
    border = index[times == 1]
    first, second = edges[border].T
    count = np.ceil(np.linalg.norm(flat[first] - flat[second], axis=1) * density / _STEP).astype(int) + 1
    number = np.repeat(np.arange(len(border)), count)
    share = (np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count)) / np.maximum(count - 1, 1)[number]
    share = share[:, None]
    along = [v[first[number]] * (1 - share) + v[second[number]] * share for v in (flat, points)]
    return border[number] % len(faces), along[0] * density, along[1] * density
