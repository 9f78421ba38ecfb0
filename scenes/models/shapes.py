"""Signed distances of round shapes, negative inside, as functions of points (N, 3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

Distance = Callable[[np.ndarray], np.ndarray]


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


def torus(centre: Sequence[float], ring: float, radius: float, rotate_deg: Sequence[float] = (0, 0, 0)) -> Distance:
    """Ring about the y axis: `ring` from the centre to the middle of the tube, whose radius is `radius`."""
    middle, turn = np.asarray(centre, np.float32), _rotation(rotate_deg)

    def distance(p: np.ndarray) -> np.ndarray:
        local = (p - middle) @ turn
        return np.hypot(np.hypot(local[:, 0], local[:, 2]) - ring, local[:, 1]) - radius

    return distance


def moved(
    shape: Distance, offset: Sequence[float], rotate_deg: Sequence[float] = (0, 0, 0), scale: float = 1.0
) -> Distance:
    """The shape scaled, turned about x, then y, then z, and moved by `offset`."""
    shift, turn = np.asarray(offset, np.float32), _rotation(rotate_deg)
    return lambda p: shape((p - shift) @ turn / scale) * scale


def both(*shapes: Distance) -> Distance:
    """What lies in any of the shapes."""
    return lambda p: np.min([shape(p) for shape in shapes], axis=0)


def _rotation(rotate_deg: Sequence[float]) -> np.ndarray:
    a, b, c = np.deg2rad(np.asarray(rotate_deg, np.float64))
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return (about_z @ about_y @ about_x).astype(np.float32)
