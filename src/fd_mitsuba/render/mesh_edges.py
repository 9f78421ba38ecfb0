"""The edges of a welded triangle mesh, each with the one or two faces beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array


@dataclass(frozen=True)
class MeshEdges:
    """E edges. Corner c of face f is numbered 3 f + c; half-edge c runs from corner c to the next one of its face."""

    half_a: np.ndarray
    """(E,) int64 half-edge of one face."""
    half_b: np.ndarray
    """(E,) int64 half-edge of the other face, -1 at a boundary edge."""


def corners(faces: np.ndarray, half_edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex indices of half-edges: where each starts, where it ends, and the face's third vertex."""
    flat, corner = faces.reshape(-1), half_edges % 3
    end = flat[half_edges + np.where(corner == 2, -2, 1)]
    return flat[half_edges], end, flat[half_edges + np.where(corner == 0, 2, -1)]


def pair_half_edges(faces: np.ndarray, half_edges: np.ndarray | None = None) -> MeshEdges:
    """Joins half-edges that lie between the same two vertices.

    Where more than two faces meet in an edge they are paired in the order of the face list; an odd one is a boundary.

    Args:
        faces: (F, 3) int64 vertex indices.
        half_edges: (H,) int64, ascending, those to join; None: all.
    """
    count = 3 * len(faces)
    half_edges = np.arange(count) if half_edges is None else half_edges
    if not len(half_edges):
        return MeshEdges(np.zeros(0, np.int64), np.zeros(0, np.int64))
    start, end, _ = corners(faces, half_edges)
    vertex_count = int(max(start.max(), end.max())) + 1
    low_bits = max(count - 1, 1).bit_length()
    edge = np.minimum(start, end).astype(np.int64, copy=False)
    edge *= vertex_count
    edge += np.maximum(start, end)
    if (vertex_count * vertex_count).bit_length() + low_bits <= 63:
        # Edge and half-edge in one number: a plain sort is several times faster than an argsort.
        edge <<= low_bits
        edge |= half_edges
        edge.sort()
        half_edges = edge & ((1 << low_bits) - 1)
        edge >>= low_bits
    else:
        order = np.argsort(edge, kind="stable")
        edge, half_edges = edge[order], half_edges[order]
    joined = np.append(edge[1:] == edge[:-1], False)  # this one and the next
    begins = np.flatnonzero(np.append(True, ~joined[:-1]))
    place = np.arange(len(edge)) - np.repeat(begins, np.diff(np.append(begins, len(edge))))
    first = np.flatnonzero(place % 2 == 0)
    following = half_edges[np.minimum(first + 1, len(edge) - 1)]
    return MeshEdges(half_edges[first], np.where(joined[first], following, -1))


def pair_closed(
    faces: np.ndarray, half_edges: np.ndarray, start: np.ndarray, end: np.ndarray, vertices: int
) -> MeshEdges:
    """`pair_half_edges`, several times faster, for half-edges that come in pairs of opposite directions.

    Of each edge's two half-edges one runs to the larger vertex and one to the smaller. Each kind is a sparse matrix of
    half-edges whose rows and columns are vertices, which scipy fills by counting instead of sorting; the two hold the
    same places. Places that are taken twice, where more than two faces meet, are left to `pair_half_edges`.

    Args:
        half_edges: (H,) int32, ascending, with the vertices where they start and end (H,) int32.
        vertices: how many there are.
    """
    up, down = np.flatnonzero(start < end), np.flatnonzero(start > end)
    upwards = _by_vertices(start[up], end[up], half_edges[up], vertices)
    downwards = _by_vertices(end[down], start[down], half_edges[down], vertices)
    if upwards.nnz + downwards.nnz < len(half_edges):  # scipy has added up what was in one place
        return pair_half_edges(faces, half_edges.astype(np.int64))
    one, two = upwards.data, downwards.data
    return MeshEdges(np.minimum(one, two).astype(np.int64), np.maximum(one, two).astype(np.int64))


def _by_vertices(rows: np.ndarray, columns: np.ndarray, half_edges: np.ndarray, vertices: int) -> csr_array:
    table = coo_array((half_edges, (rows, columns)), shape=(vertices, vertices)).tocsr()
    table.sort_indices()
    return table


def check_welded(faces: np.ndarray, edges: MeshEdges) -> None:
    """Refuses meshes whose silhouette gradients would silently be wrong.

    Raises:
        ValueError: most edges have one face only (vertices not welded), or neighbours disagree about the outside.
    """
    closed = edges.half_b >= 0
    count = int(closed.sum())
    if len(faces) >= 100 and count < 0.5 * len(closed):
        raise ValueError(f"{len(closed) - count} of {len(closed)} edges have one face only: weld the mesh's vertices")
    starts = faces.reshape(-1)  # a boundary edge's -1 reads some vertex, which does not count
    against = int((closed & (starts[edges.half_a] == starts[edges.half_b])).sum())
    if against > 0.01 * count:
        raise ValueError(f"{against} of {count} edges join faces of opposite winding: orient the mesh")
