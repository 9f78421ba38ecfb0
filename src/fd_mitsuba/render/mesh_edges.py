"""The edges of a welded triangle mesh, each with the one or two faces beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

NO_FACE = np.iinfo(np.uint32).max
_MOST_ROWS = 1 << 24
"""Of a table with a row for each vertex; above it, vertices are presumably numbered with large gaps."""


@dataclass(frozen=True)
class MeshEdges:
    """E edges. Corner c of face f is numbered 3 f + c; half-edge c runs from corner c to the next one of its face."""

    half_a: np.ndarray
    """(E,) int64 half-edge of one face."""
    half_b: np.ndarray
    """(E,) int64 half-edge of the other face, -1 at a boundary edge."""
    is_oriented: bool = False
    """Whether it is known that every edge has two faces, which agree about the outside."""

    @property
    def face_a(self) -> np.ndarray:
        """(E,) uint32."""
        return self.half_a.astype(np.uint32) // np.uint32(3)  # four times as fast as in 64 bits

    @property
    def face_b(self) -> np.ndarray:
        """(E,) uint32, `NO_FACE` at a boundary edge."""
        face = self.half_b.astype(np.uint32) // np.uint32(3)
        face[self.half_b < 0] = NO_FACE
        return face


def corners(faces: np.ndarray, half_edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex indices of half-edges: where each starts, where it ends, and the face's third vertex."""
    flat, corner = faces.reshape(-1), half_edges % 3
    start, end = _ends(flat, half_edges, corner)
    return start, end, flat[half_edges + np.where(corner == 0, 2, -1)]


def _ends(flat: np.ndarray, half_edges: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return flat[half_edges], flat[half_edges + np.where(corner == 2, -2, 1)]


def pair_half_edges(faces: np.ndarray, first: int = 0, others: np.ndarray | None = None) -> MeshEdges:
    """Joins half-edges that lie between the same two vertices.

    Where more than two faces meet in an edge they are paired in the order of the face list; an odd one is a boundary.

    Args:
        faces: (F, 3) int64 vertex indices.
        first: the half-edges of the faces before this one are left out,
        others: except these.
    """
    pairs = _pair_closed(faces, first, np.zeros(0, np.int64) if others is None else others)
    if pairs is not None:
        return pairs
    count = 3 * len(faces)
    half_edges = np.arange(3 * first, count, dtype=np.int64)
    start, end = faces[first:].reshape(-1), faces[first:][:, [1, 2, 0]].reshape(-1)
    if others is not None and len(others):
        other_start, other_end = _ends(faces.reshape(-1), others, others % 3)
        half_edges = np.concatenate([others, half_edges])
        start, end = np.concatenate([other_start, start]), np.concatenate([other_end, end])
    if not len(half_edges):
        return MeshEdges(np.zeros(0, np.int64), np.zeros(0, np.int64))
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


def _pair_closed(faces: np.ndarray, first: int, others: np.ndarray) -> MeshEdges | None:
    """`pair_half_edges` of a closed, oriented mesh, in a third of the time; None where the mesh is not like that.

    Of each edge's two half-edges one runs to the larger vertex and one to the smaller. Each kind is a sparse matrix of
    half-edges whose rows and columns are vertices, which scipy fills by counting instead of sorting. The two must hold
    the same places, once each, which is also what `check_welded` asks for.
    """
    listed, count = len(others), len(others) + 3 * (len(faces) - first)
    most = np.iinfo(np.int32).max
    if count == 0 or count % 2 or 3 * len(faces) > most or faces.max() > most:
        return None
    start, end = np.empty((2, count), np.int32)
    start[:listed], end[:listed] = _ends(faces.reshape(-1), others, others % 3)
    own_start, own_end = start[listed:].reshape(-1, 3), end[listed:].reshape(-1, 3)
    own_start[:] = faces[first:]
    own_end[:, :2], own_end[:, 2] = own_start[:, 1:], own_start[:, 0]
    is_upwards = start < end
    up, down = np.flatnonzero(is_upwards), np.flatnonzero(~is_upwards)  # taking by number is far faster than by mask
    if len(up) != len(down):
        return None
    half_edges = np.concatenate([others, np.arange(3 * first, 3 * len(faces))]).astype(np.int32)
    vertices = int(max(start.max(), end.max())) + 1
    if vertices > _MOST_ROWS:
        return None
    upwards = _by_vertices(start.take(up), end.take(up), half_edges.take(up), vertices)
    downwards = _by_vertices(end.take(down), start.take(down), half_edges.take(down), vertices)
    if not np.array_equal(upwards.indptr, downwards.indptr) or not np.array_equal(upwards.indices, downwards.indices):
        return None
    if 2 * upwards.nnz != count:  # two half-edges of one kind in one place, which scipy has added up
        return None
    one, two = upwards.data, downwards.data
    return MeshEdges(np.minimum(one, two).astype(np.int64), np.maximum(one, two).astype(np.int64), is_oriented=True)


def _by_vertices(rows: np.ndarray, columns: np.ndarray, half_edges: np.ndarray, vertices: int) -> csr_array:
    table = coo_array((half_edges, (rows, columns)), shape=(vertices, vertices)).tocsr()
    table.sort_indices()
    return table


class EdgeCache:
    """Edges of a mesh whose first faces stay the same: only the rest is paired anew."""

    def __init__(self) -> None:
        self._fixed_faces: np.ndarray | None = None
        self._fixed = MeshEdges(np.zeros(0, np.int64), np.zeros(0, np.int64))
        self._open = np.zeros(0, np.int64)

    def edges(self, faces: np.ndarray, static_faces: int = 0) -> tuple[MeshEdges, MeshEdges]:
        """The edges between static faces (the same object as long as those faces are the same), and all other edges."""
        fixed_faces = faces[:static_faces]
        if self._fixed_faces is None or not np.array_equal(self._fixed_faces, fixed_faces):
            self._fixed_faces = fixed_faces.copy()
            pairs = pair_half_edges(fixed_faces)
            closed = pairs.half_b >= 0
            self._fixed = MeshEdges(pairs.half_a[closed], pairs.half_b[closed])
            self._open = pairs.half_a[~closed]
        return self._fixed, pair_half_edges(faces, static_faces, self._open)


def check_welded(faces: np.ndarray, edges: MeshEdges) -> None:
    """Refuses meshes whose silhouette gradients would silently be wrong.

    Raises:
        ValueError: most edges have one face only (vertices not welded), or neighbours disagree about the outside.
    """
    if edges.is_oriented:
        return
    closed = edges.half_b >= 0
    count = int(closed.sum())
    if len(faces) >= 100 and count < 0.5 * len(closed):
        raise ValueError(f"{len(closed) - count} of {len(closed)} edges have one face only: weld the mesh's vertices")
    starts = faces.reshape(-1)  # a boundary edge's -1 reads some vertex, which does not count
    against = int((closed & (starts[edges.half_a] == starts[edges.half_b])).sum())
    if against > 0.01 * count:
        raise ValueError(f"{against} of {count} edges join faces of opposite winding: orient the mesh")
