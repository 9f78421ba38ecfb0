"""Edges, neighbours and faces around vertices of a closed triangle mesh, as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Edges:
    """The edges of a mesh of which every edge has exactly two faces.

    Attributes:
        ends: (E, 2) int64 vertices, the lower first.
        face_edges: (F, 3) int64, the edge between corner i and corner i + 1.
        faces: (E, 2) int64, the faces beside it.
        opposite: (E, 2) int64, the corner of each of these faces that is not on the edge.
    """

    ends: np.ndarray
    face_edges: np.ndarray
    faces: np.ndarray
    opposite: np.ndarray


def edges_of(faces: np.ndarray, count: int) -> Edges:
    """The edges of closed, manifold faces (F, 3) over `count` vertices.

    Raises:
        ValueError: an edge that has not two faces.
    """
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    key = np.minimum(start, end) * count + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    if len(key) % 2 or np.any(ordered[0::2] != ordered[1::2]) or np.any(ordered[2::2] == ordered[1:-1:2]):
        raise ValueError("an edge of the mesh has not two faces")
    pairs = order.reshape(-1, 2)
    face_edges = np.empty(len(key), dtype=np.int64)
    face_edges[pairs] = np.arange(len(pairs))[:, None]
    ends = np.stack([ordered[0::2] // count, ordered[0::2] % count], axis=1)
    opposite = faces[pairs // 3, (pairs + 2) % 3]
    return Edges(ends, face_edges.reshape(-1, 3), pairs // 3, opposite)


@dataclass(frozen=True)
class Rings:
    """What lies around each vertex: rows of `items` from `start[v]` to `start[v + 1]`."""

    start: np.ndarray
    items: np.ndarray

    def of(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The position in `vertices` (N,) that each item belongs to, and the items, one after another."""
        first, length = self.start[vertices], self.start[vertices + 1] - self.start[vertices]
        owner = np.repeat(np.arange(len(vertices)), length)
        offset = np.arange(len(owner)) - np.repeat(np.cumsum(length) - length, length)
        return owner, self.items[np.repeat(first, length) + offset]


def faces_around(faces: np.ndarray, count: int) -> Rings:
    """The faces around each of `count` vertices."""
    return _rings(faces.reshape(-1), np.repeat(np.arange(len(faces)), 3), count)


def neighbours(edges: Edges, count: int) -> Rings:
    """The vertices at the other ends of each vertex's edges."""
    return _rings(edges.ends.T.reshape(-1), edges.ends[:, ::-1].T.reshape(-1), count)


def _rings(owner: np.ndarray, items: np.ndarray, count: int) -> Rings:
    order = np.argsort(owner, kind="stable")
    start = np.zeros(count + 1, dtype=np.int64)
    np.cumsum(np.bincount(owner, minlength=count), out=start[1:])
    return Rings(start, items[order])


def cross_of_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Twice the area of each face along its normal, (F, 3)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def summed(faces: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """The sum (count, K) of the values (F, K) of the faces around each vertex."""
    total = np.zeros((count, values.shape[1]))
    for axis in range(values.shape[1]):
        for corner in range(3):
            total[:, axis] += np.bincount(faces[:, corner], values[:, axis], count)
    return total
