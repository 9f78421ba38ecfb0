"""A small modelling kit: signed distances of round shapes, joined smoothly and turned into triangle meshes.

Distances are negative inside (marching cubes wants no particular sign; these meshes never meet the package's fields).
Colours are linear RGB, stored per vertex in the PLY file as `r`, `g`, `b`; Mitsuba reads them as `vertex_color`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from skimage.measure import marching_cubes

Distance = Callable[[np.ndarray], np.ndarray]
Colour = tuple[float, float, float]


def tube(points: Sequence[Sequence[float]], radii: Sequence[float], squash: Sequence[float] = (1, 1, 1)) -> Distance:
    """Chain of tapered capsules through `points`; `squash` > 1 on an axis makes the cross-section thinner along it."""
    nodes, widths = np.asarray(points, np.float32), np.asarray(radii, np.float32)
    stretch = np.asarray(squash, np.float32)

    def distance(p: np.ndarray) -> np.ndarray:
        best = np.full(len(p), np.inf, np.float32)
        for start, end, first, last in zip(nodes[:-1], nodes[1:], widths[:-1], widths[1:], strict=True):
            axis = end - start
            along = np.clip((p - start) @ axis / (axis @ axis), 0, 1)
            offset = p - start - along[:, None] * axis
            best = np.minimum(best, np.linalg.norm(offset * stretch, axis=1) - (first + along * (last - first)))
        return best / stretch.max()

    return distance


def curve(points: Sequence[Sequence[float]], radii: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """The points and radii with three more between each two, on a Catmull-Rom spline: a `tube` of them has no kinks."""
    knots = np.column_stack([points, radii])
    padded = np.vstack([2 * knots[0] - knots[1], knots, 2 * knots[-1] - knots[-2]])
    t = np.linspace(0, 1, 4, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True)
    ]
    fine = np.vstack([*pieces, knots[-1:]])
    return fine[:, :3], fine[:, 3]


def ellipsoid(centre: Sequence[float], radii: Sequence[float], rotate_deg: Sequence[float] = (0, 0, 0)) -> Distance:
    """Ellipsoid with half-lengths `radii`, turned about x, then y, then z (first-order distance)."""
    middle, size = np.asarray(centre, np.float32), np.asarray(radii, np.float32)
    turn = _rotation(rotate_deg)

    def distance(p: np.ndarray) -> np.ndarray:
        local = (p - middle) @ turn
        inner = np.linalg.norm(local / size, axis=1)
        return inner * (inner - 1) / np.maximum(np.linalg.norm(local / size**2, axis=1), 1e-6)

    return distance


def box(
    centre: Sequence[float], half: Sequence[float], rounding: float, rotate_deg: Sequence[float] = (0, 0, 0)
) -> Distance:
    """Box with half-lengths `half`, edges rounded by `rounding`."""
    middle, size = np.asarray(centre, np.float32), np.asarray(half, np.float32) - rounding
    turn = _rotation(rotate_deg)

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs((p - middle) @ turn) - size
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0) - rounding

    return distance


def lathe(profile: Sequence[Sequence[float]], rounding: float = 0.0) -> Distance:
    """Solid of revolution about the y axis: `profile` is the closed polygon (radius, y) of its cross-section."""
    corners = np.asarray(profile, np.float32)

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.stack([np.hypot(p[:, 0], p[:, 2]), p[:, 1]], axis=1)
        best, inside = np.full(len(q), np.inf, np.float32), np.zeros(len(q), bool)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            edge, to = end - start, q - start
            along = np.clip(to @ edge / (edge @ edge), 0, 1)
            best = np.minimum(best, np.linalg.norm(to - along[:, None] * edge, axis=1))
            spans = (start[1] > q[:, 1]) != (end[1] > q[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                inside ^= spans & (q[:, 0] < edge[0] * (q[:, 1] - start[1]) / edge[1] + start[0])
        return np.where(inside, -best, best) - rounding

    return distance


def mirrored(shape: Distance) -> Distance:
    """The shape (drawn on the +x side) and its mirror image on the -x side."""
    return lambda p: np.minimum(shape(p), shape(p * np.array([-1, 1, 1], np.float32)))


@dataclass
class Model:
    """Shapes joined in order; each brings its colour and the width over which it melts into what is there already."""

    colour: Colour
    shapes: list[tuple[Distance, float, Colour | None]] = field(default_factory=list)
    paints: list[tuple[Distance, Colour]] = field(default_factory=list)

    def add(self, shape: Distance, blend: float = 0.0, colour: Colour | None = None) -> None:
        self.shapes.append((shape, blend, colour or self.colour))

    def cut(self, shape: Distance) -> None:
        """Removes `shape` from everything added so far."""
        self.shapes.append((shape, 0.0, None))

    def paint(self, shape: Distance, colour: Colour) -> None:
        """Colours the surface inside `shape` without changing its form."""
        self.paints.append((shape, colour))

    def distance(self, p: np.ndarray) -> np.ndarray:
        total = np.full(len(p), 1e3, np.float32)
        for shape, blend, colour in self.shapes:
            d = shape(p)
            if colour is None:
                total = np.maximum(total, -d)
            elif blend:
                bump = np.maximum(blend - np.abs(total - d), 0) / blend
                total = np.minimum(total, d) - bump**2 * blend / 4
            else:
                total = np.minimum(total, d)
        return total

    def colours(self, p: np.ndarray, softness: float) -> np.ndarray:
        """Linear RGB: the colour of the last shape that a point lies on, faded over `softness`."""
        result = np.tile(np.asarray(self.colour, np.float32), (len(p), 1))
        coloured = [(shape, colour) for shape, _, colour in self.shapes if colour not in (None, self.colour)]
        for shape, colour in coloured + self.paints:
            weight = np.clip(1.2 - shape(p) / softness, 0, 1)[:, None]
            result = result * (1 - weight) + np.asarray(colour, np.float32) * weight
        return result

    def mesh(self, low: Sequence[float], high: Sequence[float], cell: float) -> trimesh.Trimesh:
        """Closed surface inside the box [low, high] with edges of about `cell`."""
        axes = [np.arange(a, b + cell, cell, dtype=np.float32) for a, b in zip(low, high, strict=True)]
        lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        values = np.concatenate([self.distance(block) for block in np.array_split(lattice.reshape(-1, 3), 16)])
        positions, triangles, _, _ = marching_cubes(values.reshape(lattice.shape[:3]), 0.0, gradient_direction="ascent")
        surface = trimesh.Trimesh(positions * cell + np.asarray(low), triangles, process=True)
        for _ in range(6):  # evens out the slivers of marching cubes, each time back onto the exact surface
            trimesh.smoothing.filter_laplacian(surface, lamb=0.5, iterations=1, volume_constraint=False)
            surface.vertices = self._onto_surface(np.asarray(surface.vertices, np.float32), cell)
        if surface.volume < 0:
            surface.invert()
        if not surface.is_watertight:
            raise RuntimeError("the mesh is not closed; make the cell smaller or the box larger")
        return surface

    def _onto_surface(self, p: np.ndarray, cell: float) -> np.ndarray:
        step = 0.1 * cell
        axes = np.eye(3, dtype=np.float32) * step
        gradient = np.stack([self.distance(p + a) - self.distance(p - a) for a in axes], axis=1) / (2 * step)
        length = np.maximum((gradient**2).sum(axis=1), 0.25)
        move = -gradient * (self.distance(p) / length)[:, None]
        return p + np.clip(move, -0.5 * cell, 0.5 * cell)


def write_ply(path: Path, surface: trimesh.Trimesh, colours: np.ndarray | None) -> None:
    """Writes a binary PLY: float positions, optional linear float colours, no normals."""
    vertex = np.zeros(len(surface.vertices), dtype=[(name, "<f4") for name in ("x", "y", "z", "r", "g", "b")])
    for index, name in enumerate("xyz"):
        vertex[name] = surface.vertices[:, index]
    names = "xyz"
    if colours is not None:
        names = "xyzrgb"
        for index, name in enumerate("rgb"):
            vertex[name] = colours[:, index]
    face = np.zeros(len(surface.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    face["count"], face["index"] = 3, surface.faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    columns = np.stack([vertex[name] for name in names], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(header).encode() + columns.astype("<f4").tobytes() + face.tobytes())


def _rotation(rotate_deg: Sequence[float]) -> np.ndarray:
    a, b, c = np.deg2rad(np.asarray(rotate_deg, np.float64))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return (about_z @ about_y @ about_x).astype(np.float32)
