"""The last thin triangles of a mesh taken away one by one, each by what leaves the best triangles around it.

Even remeshing leaves few: where vertices are held along the rim of the joint, where two creases meet, where the last
projection slid neighbours together. Each of those is tried by itself, with every change that could help:

    turn       one of its edges becomes the other diagonal of the two faces beside it
    shrink     one of its edges becomes a point: an end of it, or its middle
    slide      one of its corners moves to the middle of the faces around it, or half the way

What counts is the smallest angle of all faces that a change touches. A change that turns a face over, or moves the
surface by more than a given distance, is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fd_mitsuba.export.final_surface.mesh_rings import faces_around
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.scene.mesh_distance import MeshDistance

_ROUNDS = 6
_BETTER_DEG = 1.0
"""A change must help by as much: else two could undo each other for ever."""
_TURNED, _TURNED_SLIVER = 0.5, 0.2
"""The least cosine between a face's normal before and after; a sliver's own says nothing, so that of all around is
taken."""
_SLIVER_DEG = 4.0


def without_slivers(
    vertices: np.ndarray, faces: np.ndarray, least_angle_deg: float, farthest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) without angles below `least_angle_deg` where that can be, and which vertices moved.

    Args:
        vertices: (V, 3). faces: (F, 3) closed and manifold; stays so, with the same pieces and holes.
        farthest: how far the surface may move, in the vertices' unit.

    Returns:
        vertices, faces, and (V,) bool: the vertices that are not where one was before.
    """
    mesh = _Mesh(vertices, faces)
    for _ in range(_ROUNDS):
        angles = smallest_angles(mesh.vertices, mesh.faces)
        thin = np.flatnonzero((angles < least_angle_deg) & mesh.alive)
        better = False
        for face in thin[np.argsort(angles[thin], kind="stable")].tolist():
            better |= mesh.improve(face, least_angle_deg, farthest)
        if not better:
            break
    return mesh.compact()


@dataclass(frozen=True)
class _Change:
    """Faces that go, those that come, and a vertex that moves with them.

    Attributes:
        gone: numbers of faces.
        made: (K, 3) the faces in place of them.
        vertex: which one moves; -1: none.
        place: (3,) where it goes.
        kept: (K,) the place in `gone` of the face that each one was before; -1: it is new.
        moved: (N, 3) points of the surface before that it is to stay near to.
    """

    gone: list[int]
    made: np.ndarray
    vertex: int
    place: np.ndarray
    kept: np.ndarray
    moved: np.ndarray


class _Mesh:
    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.vertices = np.array(vertices, dtype=np.float64)
        self.faces = np.array(faces, dtype=np.int64)
        self.alive = np.ones(len(faces), dtype=bool)
        self._moved = np.zeros(len(vertices), dtype=bool)
        self._rings = faces_around(self.faces, len(vertices))
        self._around: dict[int, set[int]] = {}  # of vertices whose faces are no longer those of `_rings`

    def improve(self, face: int, least_angle_deg: float, farthest: float) -> bool:
        """Make the best change around a face, if one helps."""
        if not self.alive[face] or smallest_angles(self.vertices, self.faces[face : face + 1])[0] >= least_angle_deg:
            return False
        best, most = None, 0.0
        for change in self._changes(face):
            before = float(smallest_angles(self.vertices, self.faces[change.gone]).min())
            corners = self._corners(change)
            after = float(smallest_angles(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3)).min())
            # What is above the wish anyway is not worth a change elsewhere.
            gain = min(after, 2 * least_angle_deg) - before
            if gain > max(most, _BETTER_DEG) and self._fits(change, corners, farthest):
                best, most = change, gain
        if best is not None:
            self._make(best)
        return best is not None

    def compact(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        faces = self.faces[self.alive]
        used, faces = np.unique(faces, return_inverse=True)
        return self.vertices[used], faces.reshape(-1, 3), self._moved[used]

    def _faces_of(self, vertex: int) -> set[int]:
        if vertex not in self._around:
            start, end = self._rings.start[vertex : vertex + 2]
            self._around[vertex] = set(self._rings.items[start:end].tolist())
        return self._around[vertex]

    def _changes(self, face: int) -> Iterator[_Change]:
        for corner in range(3):
            a, b = self.faces[face, [corner, (corner + 1) % 3]].tolist()
            pair = sorted(self._faces_of(a) & self._faces_of(b))
            if len(pair) != 2:
                continue
            c, d = (next(v for v in self.faces[number].tolist() if v not in (a, b)) for number in pair)
            yield from self._turn(a, b, c, d, pair)
            yield from self._shrink(a, b, c, d)
        for vertex in self.faces[face].tolist():
            yield from self._slide(vertex)

    def _turn(self, a: int, b: int, c: int, d: int, pair: list[int]) -> Iterator[_Change]:
        if self._faces_of(c) & self._faces_of(d) or min(len(self._faces_of(v)) for v in (a, b)) < 4:
            return
        first = self.faces[pair[0]].tolist()
        if first[(first.index(a) + 1) % 3] != b:  # so that the first face runs a b c
            a, b = b, a
        made = np.array([[a, d, c], [d, b, c]])
        middle = self.vertices[[a, b]].mean(axis=0)
        yield _Change(pair, made, -1, np.zeros(3), np.array([-1, -1]), middle[None])

    def _shrink(self, a: int, b: int, c: int, d: int) -> Iterator[_Change]:
        around = [self._faces_of(v) for v in (a, b)]
        near = [{v for number in own for v in self.faces[number].tolist()} for own in around]
        if near[0] & near[1] != {a, b, c, d} or min(len(self._faces_of(v)) for v in (c, d)) < 4:
            return
        gone = sorted(around[0] | around[1])
        rows = self.faces[gone]
        stays = ~((rows == a).any(axis=1) & (rows == b).any(axis=1))
        made = np.where(rows == b, a, rows)[stays]
        both = self.vertices[[a, b]]
        for place in (both[0], both[1], both.mean(axis=0)):
            yield _Change(gone, made, a, place, np.flatnonzero(stays), both)

    def _slide(self, vertex: int) -> Iterator[_Change]:
        gone = sorted(self._faces_of(vertex))
        rows = self.faces[gone]
        corners = self.vertices[rows]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        if not area.sum() > 0:
            return
        here = self.vertices[vertex]
        move = (corners.mean(axis=1) * area[:, None]).sum(axis=0) / area.sum() - here
        for share in (1.0, 0.5):
            yield _Change(gone, rows, vertex, here + share * move, np.arange(len(gone)), here[None])

    def _corners(self, change: _Change) -> np.ndarray:
        """(K, 3, 3) where the corners of the faces made are."""
        corners = self.vertices[change.made]
        if change.vertex >= 0:
            corners[change.made == change.vertex] = change.place
        return corners

    def _fits(self, change: _Change, corners: np.ndarray, farthest: float) -> bool:
        old = self.vertices[self.faces[change.gone]]
        before = np.cross(old[:, 1] - old[:, 0], old[:, 2] - old[:, 0])
        after = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        own = before[change.kept]
        thin = smallest_angles(old.reshape(-1, 3), np.arange(3 * len(old)).reshape(-1, 3))[change.kept] < _SLIVER_DEG
        thin |= change.kept < 0
        own[thin] = before.sum(axis=0)
        cosine = np.einsum("ij,ij->i", own, after)
        cosine /= np.maximum(np.linalg.norm(own, axis=1) * np.linalg.norm(after, axis=1), 1e-30)
        if (cosine < np.where(thin, _TURNED_SLIVER, _TURNED)).any():
            return False
        made = MeshDistance(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
        if made.unsigned(change.moved).max() > farthest:
            return False
        places = corners.mean(axis=1) if change.vertex < 0 else change.place[None]
        was = MeshDistance(old.reshape(-1, 3), np.arange(3 * len(old)).reshape(-1, 3))
        return bool(was.unsigned(places).max() <= farthest)

    def _make(self, change: _Change) -> None:
        for number in change.gone:
            for vertex in self.faces[number].tolist():
                self._faces_of(vertex).discard(number)
            self.alive[number] = False
        for number, row in zip(change.gone, change.made.tolist(), strict=False):  # never more than there were
            self.faces[number], self.alive[number] = row, True
            for vertex in row:
                self._faces_of(vertex).add(number)
        if change.vertex >= 0:
            self._moved[change.vertex] |= bool((self.vertices[change.vertex] != change.place).any())
            self.vertices[change.vertex] = change.place
