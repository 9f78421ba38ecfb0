"""A triangle mesh as plain arrays, and what can be said about its topology."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class TriangleMesh:
    """One mesh of the base, or of a region; the arrays are read-only.

    Attributes:
        name: the shape's id in the scene file.
        vertices: (V, 3) float64 in the frame that the holder states.
        faces: (F, 3) int64, every index in [0, V), counter-clockwise seen from outside.
        source_files: the files that it was read from (none for an analytic shape), in the user's folders.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    source_files: tuple[Path, ...] = field(default=())

    def __post_init__(self) -> None:
        for name, dtype in (("vertices", np.float64), ("faces", np.int64)):
            array = np.array(getattr(self, name), dtype=dtype).reshape(-1, 3)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def volume(self) -> float:
        """Signed enclosed volume, positive for outward faces; exact only for a closed mesh."""
        corners = self.vertices[self.faces] - self.vertices.mean(axis=0)
        return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


@dataclass(frozen=True)
class Topology:
    """Counts of a mesh after vertices at exactly the same position are taken as one (a UV seam is no hole).

    Attributes:
        closed: no boundary edge; every edge has as many faces one way round as the other.
        components: connected pieces.
        boundary_edges: edges with a side missing.
        nonmanifold_edges: edges with more than two faces.
        duplicate_vertices: vertices whose position another vertex already has.
        degenerate_faces: faces without area.
        duplicate_faces: faces with the same three positions as another, beyond the first.
        misoriented_edges: edges of two faces that both run the same way, so that their normals disagree.
    """

    closed: bool
    components: int
    boundary_edges: int
    nonmanifold_edges: int
    duplicate_vertices: int
    degenerate_faces: int
    duplicate_faces: int
    misoriented_edges: int


def topology(vertices: np.ndarray, faces: np.ndarray) -> Topology:
    """The `Topology` of vertices (V, 3) and faces (F, 3)."""
    _, weld = np.unique(np.asarray(vertices) + 0.0, axis=0, return_inverse=True)
    weld = weld.reshape(-1)
    used = np.unique(faces)
    welded = weld[faces]
    corners = np.asarray(vertices)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    distinct = (welded[:, 0] != welded[:, 1]) & (welded[:, 1] != welded[:, 2]) & (welded[:, 2] != welded[:, 0])
    solid = welded[distinct]
    directed = np.concatenate([solid[:, [0, 1]], solid[:, [1, 2]], solid[:, [2, 0]]])
    edges, edge_of = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(-1)
    faces_per_edge = np.bincount(edge_of, minlength=len(edges))
    balance = np.bincount(edge_of, weights=np.where(directed[:, 0] < directed[:, 1], 1, -1), minlength=len(edges))
    count = int(weld.max()) + 1 if len(weld) else 0
    graph = coo_array((np.ones(len(directed)), (directed[:, 0], directed[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    return Topology(
        closed=bool(len(edges)) and not bool(np.any(balance)),
        components=len(np.unique(labels[np.unique(solid)])) if len(solid) else 0,
        boundary_edges=int(np.sum(faces_per_edge == 1)),
        nonmanifold_edges=int(np.sum(faces_per_edge > 2)),
        duplicate_vertices=len(used) - len(np.unique(weld[used])),
        degenerate_faces=int(np.sum((area == 0) | ~distinct)),
        duplicate_faces=len(solid) - len(np.unique(np.sort(solid, axis=1), axis=0)) if len(solid) else 0,
        misoriented_edges=int(np.sum((faces_per_edge == 2) & (balance != 0))),
    )
