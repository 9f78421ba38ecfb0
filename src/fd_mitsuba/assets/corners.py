"""Meshes whose corners have indices of their own into positions, UVs and normals: polygons to triangles, one vertex a
combination, as renderers want it."""

from __future__ import annotations

from dataclasses import dataclass, field

import manifold3d
import numpy as np

from fd_mitsuba.assets.asset import AssetMesh


@dataclass
class Corners:
    """Polygons as runs of corners.

    Attributes:
        positions: (P, 3).
        counts: (N,) corners of each polygon, at least 3.
        position: (C,) index of each corner's position, polygon after polygon.
        uvs: (T, 2), and `uv` (C,) indices into it, -1 where a corner has none; origin top left.
        normals: (M, 3), and `normal` (C,) likewise.
        colours: (P, 3) linear in [0, 1], at positions.
        face_colours: (N, 3) of polygons.
    """

    positions: np.ndarray
    counts: np.ndarray
    position: np.ndarray
    uvs: np.ndarray | None = None
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None
    normal: np.ndarray | None = None
    colours: np.ndarray | None = None
    face_colours: np.ndarray | None = None
    starts: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.starts = np.concatenate([[0], np.cumsum(self.counts)[:-1]]).astype(np.int64)

    def mesh(self, name: str, polygons: np.ndarray | None = None, material: int = -1) -> AssetMesh:
        """The triangles of some polygons (by number; None: all) with the vertices that they use.

        Where not all corners have a normal, the mesh has none.
        """
        chosen = np.arange(len(self.counts)) if polygons is None else polygons
        corner, owner = self._triangles(chosen)
        keys, rows = [self.position[corner]], {}
        if self.uv is not None and self.uvs is not None and (self.uv[corner] >= 0).any():
            keys.append(self.uv[corner])
            rows["uv"] = len(keys) - 1
        if self.normal is not None and self.normals is not None and (self.normal[corner] >= 0).all():
            keys.append(self.normal[corner])
            rows["normal"] = len(keys) - 1
        if self.face_colours is not None:
            colour_of = np.unique(self.face_colours, axis=0, return_inverse=True)[1].reshape(-1)
            keys.append(colour_of[owner])
        table = np.stack(keys, axis=1)
        # In the order in which faces use them, so that a mesh without seams keeps that of its file where faces do.
        _, first, place = np.unique(table, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(table[first, 0], kind="stable")
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        used = first[order]
        uvs = {}
        if "uv" in rows:
            index = table[used, rows["uv"]]
            assert self.uvs is not None
            uvs[0] = np.where((index >= 0)[:, None], self.uvs[np.maximum(index, 0)], 0.0)
        normals = self.normals[table[used, rows["normal"]]] if "normal" in rows and self.normals is not None else None
        colours = None if self.colours is None else self.colours[table[used, 0]]
        if self.face_colours is not None:
            colours = self.face_colours[owner[used]]
        faces = rank[place.reshape(-1)].reshape(-1, 3)
        return AssetMesh(name, self.positions[table[used, 0]], faces, material, normals, uvs, colours)

    def _triangles(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corner numbers (3 T,) of the triangles of some polygons in their order, and the polygon (3 T,) of each."""
        counts, starts = self.counts[chosen], self.starts[chosen]
        if (counts == 3).all():
            return (starts[:, None] + np.arange(3)).ravel(), np.repeat(chosen, 3)
        pieces, owners, place = [], [], []
        for count in np.unique(counts):
            here = np.nonzero(counts == count)[0]
            corner = starts[here][:, None] + np.arange(count)
            fans = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
            cut = np.broadcast_to(fans, (len(here), count - 2, 3)).copy()
            if count > 3:
                self._cut_concave(corner, cut)
            pieces.append(np.take_along_axis(corner[:, None, :], cut, axis=2).reshape(-1, 3))
            owners.append(np.repeat(chosen[here], count - 2))
            place.append(np.repeat(here, count - 2))
        order = np.argsort(np.concatenate(place), kind="stable")
        return np.concatenate(pieces)[order].ravel(), np.repeat(np.concatenate(owners)[order], 3)

    def _cut_concave(self, corner: np.ndarray, cut: np.ndarray) -> None:
        """Replace the fans of polygons with corners (N, n) that a fan would leave, in place."""
        points = self.positions[self.position[corner]]
        edges = points[:, 1:] - points[:, :1]
        normal = np.cross(edges[:, :-1], edges[:, 1:])
        whole = normal.sum(axis=1)
        folds = (np.einsum("nij,nj->ni", normal, whole) < -1e-6 * np.einsum("nj,nj->n", whole, whole)[:, None]).any(1)
        for number in np.nonzero(folds)[0]:
            made = _ear_clipped(points[number], whole[number])
            if made is not None and len(made) == len(cut[number]):
                cut[number] = made


def _ear_clipped(points: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """Triangles (n - 2, 3) of one polygon (n, 3); None where it cannot be cut properly."""
    length = np.linalg.norm(normal)
    if not length > 0:
        return None
    axis = normal / length
    right = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    right /= np.linalg.norm(right)
    flat = np.stack([points @ right, points @ np.cross(axis, right)], axis=1)
    return np.asarray(manifold3d.triangulate([flat - flat.mean(axis=0)]), dtype=np.int64)
