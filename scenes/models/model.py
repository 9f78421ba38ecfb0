"""A model: shapes joined smoothly into one closed surface, and how that surface looks at every point.

Distances are negative inside (marching cubes wants no particular sign; these meshes never meet the package's fields).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from skimage.measure import marching_cubes

from models.shapes import Distance

Look = tuple[float, ...]
"""Linear red, green, blue in [0, 1], and the roughness in [0, 1] if it differs from the model's."""

Finish = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]
"""(points (N, 3), unit normals (N, 3), looks (N, 4), seed) -> looks (N, 4): the fine pattern on the flat colours."""


@dataclass
class Model:
    """Shapes joined in order; each brings its look and the width over which it melts into what is there already."""

    look: Look
    roughness: float = 0.7
    shapes: list[tuple[Distance, float, Look | None]] = field(default_factory=list)
    paints: list[tuple[Distance, Look, float]] = field(default_factory=list)
    finish: Finish | None = None

    def add(self, shape: Distance, blend: float = 0.0, look: Look | None = None) -> None:
        self.shapes.append((shape, blend, look or self.look))

    def cut(self, shape: Distance) -> None:
        """Removes `shape` from everything added so far."""
        self.shapes.append((shape, 0.0, None))

    def paint(self, shape: Distance, look: Look, fade: float = 0.01) -> None:
        """Colours the surface inside `shape`, faded out over `fade` around it, without changing its form."""
        self.paints.append((shape, look, fade))

    def distance(self, p: np.ndarray) -> np.ndarray:
        total = np.full(len(p), 1e3, np.float32)
        for shape, blend, look in self.shapes:
            d = shape(p)
            if look is None:
                total = np.maximum(total, -d)
            elif blend:
                bump = np.maximum(blend - np.abs(total - d), 0) / blend
                total = np.minimum(total, d) - bump**2 * blend / 4
            else:
                total = np.minimum(total, d)
        return total

    def looks(self, p: np.ndarray, normals: np.ndarray, seed: int, fade: float = 0.012) -> np.ndarray:
        """(N, 4) colour and roughness at surface points: the last shape that a point lies on, then paint, then finish.

        Args:
            fade: width of the border between two shapes' colours.
        """
        result = np.tile(self._full(self.look), (len(p), 1))
        layers = [(shape, look, fade) for shape, _, look in self.shapes if look not in (None, self.look)]
        for shape, look, width in layers + self.paints:
            weight = np.clip(1.2 - shape(p) / width, 0, 1)[:, None]
            result = result * (1 - weight) + self._full(look) * weight
        if self.finish is not None:
            result = self.finish(p, normals, result, seed)
        return np.clip(result, 0, 1).astype(np.float32)

    def mesh(self, low: Sequence[float], high: Sequence[float], cell: float) -> trimesh.Trimesh:
        """Closed surface inside the box [low, high] with edges of about `cell`."""
        axes = [np.arange(a, b + cell, cell, dtype=np.float32) for a, b in zip(low, high, strict=True)]
        values = self._sampled(axes, cell)
        positions, triangles, _, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
        surface = trimesh.Trimesh(positions * cell + np.asarray(low), triangles, process=True)
        if surface.volume < 0:
            surface.invert()
        _fill_cavities(surface)
        for _ in range(6):  # evens out the slivers of marching cubes, each time back onto the exact surface
            trimesh.smoothing.filter_laplacian(surface, lamb=0.5, iterations=1, volume_constraint=False)
            surface.vertices = self._onto_surface(np.asarray(surface.vertices, np.float32), cell)
        if not surface.is_watertight:
            raise RuntimeError("the mesh is not closed; make the cell smaller or the box larger")
        return surface

    def _sampled(self, axes: list[np.ndarray], cell: float) -> np.ndarray:
        """Distances on the lattice: exact near the surface, those of the nearest coarse site further away."""
        step = 4
        coarse = np.stack(np.meshgrid(*(axis[::step] for axis in axes), indexing="ij"), axis=-1)
        values = self.distance(coarse.reshape(-1, 3)).reshape(coarse.shape[:3])
        nearest = [np.minimum((np.arange(len(a)) + step // 2) // step, len(a[::step]) - 1) for a in axes]
        values = values[np.ix_(*nearest)]
        near = np.argwhere(np.abs(values) < 2.0 * step * cell)
        points = np.stack([axis[near[:, i]] for i, axis in enumerate(axes)], axis=1)
        blocks = [self.distance(block) for block in np.array_split(points, 8)]
        values[tuple(near.T)] = np.concatenate(blocks)
        return values

    def _full(self, look: Look) -> np.ndarray:
        return np.array([*look[:3], look[3] if len(look) > 3 else self.roughness], np.float32)

    def _onto_surface(self, p: np.ndarray, cell: float) -> np.ndarray:
        step = 0.1 * cell
        axes = np.eye(3, dtype=np.float32) * step
        gradient = np.stack([self.distance(p + a) - self.distance(p - a) for a in axes], axis=1) / (2 * step)
        length = np.maximum((gradient**2).sum(axis=1), 0.25)
        move = -gradient * (self.distance(p) / length)[:, None]
        return p + np.clip(move, -0.5 * cell, 0.5 * cell)


def _fill_cavities(surface: trimesh.Trimesh) -> None:
    """Removes pieces that face inwards: hollows between shapes, which nobody sees."""
    label = trimesh.graph.connected_component_labels(surface.face_adjacency, node_count=len(surface.faces))
    corners = surface.triangles
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    hollow = np.bincount(label, weights=volume) <= 0
    if hollow.any():
        surface.update_faces(~hollow[label])
        surface.remove_unreferenced_vertices()
