"""A closed triangle solid: its volume, whether it is manifold, its gap to the base."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import manifold3d
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology

LEAST_FACES = 100
"""A smaller face budget leaves no shape to speak of."""


@dataclass(frozen=True)
class Solid:
    """The space enclosed by triangles that run counter-clockwise seen from outside.

    Attributes:
        vertices: (V, 3) float32, in the frame that the maker states.
        faces: (F, 3) int64; none at all where there is no solid.
        islands_removed: stray pieces that were left out.
        bridged: how far the part had to swell to reach the base, canonical units; 0: it reached by itself.
    """

    vertices: np.ndarray
    faces: np.ndarray
    islands_removed: int = 0
    bridged: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", np.array(self.vertices, dtype=np.float32, order="C").reshape(-1, 3))
        object.__setattr__(self, "faces", np.array(self.faces, dtype=np.int64, order="C").reshape(-1, 3))

    @cached_property
    def volume(self) -> float:
        """Enclosed volume in cubic units of the frame."""
        return TriangleMesh("solid", self.vertices, self.faces).volume() if len(self.faces) else 0.0

    @cached_property
    def manifold(self) -> bool:
        """Whether it is closed and oriented, has two faces at every edge and a positive volume, and manifold3d agrees.

        manifold3d alone would split an edge of four faces in silence.
        """
        if not self.volume > 0:
            return False
        found, made = topology(self.vertices, self.faces), self.to_manifold()
        edges_are_good = found.closed and found.nonmanifold_edges == found.duplicate_faces == 0
        return edges_are_good and made.status() == manifold3d.Error.NoError and not made.is_empty()

    def to_manifold(self) -> manifold3d.Manifold:
        """The solid for boolean operations; ask its `status()` whether it is one."""
        return manifold3d.Manifold(manifold3d.Mesh(self.vertices, self.faces.astype(np.uint32)))

    def moved(self, matrix: np.ndarray) -> Solid:
        """The solid under an affine map (4, 4) that is not singular; `bridged` stays as it was."""
        vertices = self.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = self.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else self.faces
        return replace(self, vertices=vertices, faces=faces)

    def pieces(self) -> np.ndarray:
        """The connected piece, counted from 0, that each face (F,) belongs to."""
        pairs = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]]])
        count = len(self.vertices)
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        label = connected_components(graph, directed=False)[1][self.faces[:, 0]]
        return np.unique(label, return_inverse=True)[1]

    def gap(self, base: TriangleMesh) -> float:
        """The largest distance of any piece to the base, 0 where each enters or touches it; in the frame's units.

        Measured from the vertices and face centres, and from the base's vertices inside the solid.
        """
        if not len(self.faces):
            return 0.0
        distance, piece = MeshDistance(base.vertices, base.faces), self.pieces()
        gaps = []
        for number in range(piece.max() + 1):
            faces = self.faces[piece == number]
            points = np.concatenate([self.vertices[np.unique(faces)], self.vertices[faces].mean(axis=1)])
            enters = distance.inside(points).any() or MeshDistance(self.vertices, faces).inside(base.vertices).any()
            gaps.append(0.0 if enters else float(distance.unsigned(points).min()))
        return max(gaps)
