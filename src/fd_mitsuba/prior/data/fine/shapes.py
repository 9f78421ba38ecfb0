"""Closed solids that detailed parts need beside `data.primitives`: thin sheets, strips, loops, discs on any axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fd_mitsuba.prior.data.primitives import Array, Solid, lathe, sweep, transform, tube


def unit(vector: Array) -> Array:
    """Vectors (..., 3) of length 1."""
    vector = np.asarray(vector, float)
    return vector / (np.linalg.norm(vector, axis=-1, keepdims=True) + 1e-12)


def frame_towards(direction: ArrayLike, forward: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """The rotation (3, 3) that takes +y to `direction` and +z as near to `forward` as that leaves it."""
    up = unit(np.asarray(direction, float))
    front = np.asarray(forward, float) - np.dot(forward, up) * up
    if np.linalg.norm(front) < 1e-6:
        front = np.eye(3)[np.argmin(np.abs(up))]
        front = front - (front @ up) * up
    front = unit(front)
    return np.stack([np.cross(up, front), up, front], axis=1)


def sheet(grid: Array, thickness: ArrayLike) -> Solid:
    """A closed thin solid about a grid of points (m, n, 3), half as thick at its border.

    Args:
        thickness: one number, or (m, n).
    """
    grid = np.asarray(grid, float)
    m, n = grid.shape[:2]
    normal = unit(np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)))
    thick = np.broadcast_to(np.asarray(thickness, float), (m, n)).copy()
    border = np.ones((m, n), bool)
    border[1:-1, 1:-1] = False
    thick[border] *= 0.5
    away = normal * thick[..., None] / 2
    vertices = np.concatenate([(grid + away).reshape(-1, 3), (grid - away).reshape(-1, 3)])
    i, j = np.meshgrid(np.arange(m - 1), np.arange(n - 1), indexing="ij")
    a, b, c, d = (k.ravel() for k in (i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1))
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    ring = np.concatenate(
        [
            np.arange(m - 1) * n,
            (m - 1) * n + np.arange(n - 1),
            np.arange(m - 1, 0, -1) * n + n - 1,
            np.arange(n - 1, 0, -1),
        ]
    )
    following = np.roll(ring, -1)
    lower = m * n
    side = np.concatenate(
        [
            np.stack([following, ring, ring + lower], 1),
            np.stack([following, ring + lower, following + lower], 1),
        ]
    )
    return Solid(vertices, np.concatenate([top, top[:, ::-1] + lower, side]))


def strip(
    points: ArrayLike, width_direction: ArrayLike, half_widths: ArrayLike, half_thickness: ArrayLike, segments: int = 10
) -> Solid:
    """A band along points (n, 3), flat across: a feather, a blade, a strap. `half_widths` is (n,) or one number."""
    points = np.asarray(points, float)
    count = len(points)
    along_path = unit(np.gradient(points, axis=0))
    across = np.broadcast_to(np.asarray(width_direction, float), (count, 3))
    across = unit(across - (across * along_path).sum(1, keepdims=True) * along_path)
    over = np.cross(along_path, across)
    wide = np.broadcast_to(np.asarray(half_widths, float), count)[:, None]
    thick = np.broadcast_to(np.asarray(half_thickness, float), count)[:, None]
    return sweep(points, across * wide, over * thick, segments, exponent=0.8)


def loop(points: ArrayLike, radii: ArrayLike, normal: ArrayLike, flatten: float = 1.0, segments: int = 10) -> Solid:
    """A closed tube through the points (n, 3), the last joined to the first.

    Args:
        radii: one number or (n,): half-width along `normal`.
        normal: a direction that the path lies roughly across.
        flatten: thickness across the path and `normal`, as a share of the radius.
    """
    points = np.asarray(points, float)
    count = len(points)
    path = unit(np.roll(points, -1, 0) - np.roll(points, 1, 0))
    across = np.broadcast_to(np.asarray(normal, float), (count, 3))
    across = unit(across - (across * path).sum(1, keepdims=True) * path)
    over = np.cross(path, across)
    wide = np.broadcast_to(np.asarray(radii, float), count)[:, None, None]
    angles = np.arange(segments) * (2 * np.pi / segments)
    rings = points[:, None] + wide * (
        np.cos(angles)[None, :, None] * across[:, None] + flatten * np.sin(angles)[None, :, None] * over[:, None]
    )
    i, j = np.meshgrid(np.arange(count), np.arange(segments), indexing="ij")
    here, beside = (i * segments + j).ravel(), (i * segments + (j + 1) % segments).ravel()
    above, above_beside = (here + segments) % (count * segments), (beside + segments) % (count * segments)
    faces = np.concatenate([np.stack([here, beside, above_beside], 1), np.stack([here, above_beside, above], 1)])
    return Solid(rings.reshape(-1, 3), faces)


def torus(
    centre: ArrayLike, radius: float, thick: float, axis: ArrayLike = (0.0, 1.0, 0.0), flatten: float = 1.0
) -> Solid:
    """A ring about `axis`; `thick` is half its height along the axis, `flatten` times that its half-width across."""
    angle = np.arange(28) * (2 * np.pi / 28)
    turn = frame_towards(axis)
    points = np.stack([radius * np.sin(angle), np.zeros(28), radius * np.cos(angle)], 1) @ turn.T
    return loop(points + np.asarray(centre, float), thick, axis, flatten)


def disc(centre: ArrayLike, radius: float, half_width: float, axis: ArrayLike = (1.0, 0.0, 0.0)) -> Solid:
    """A cylinder with rounded edges about `axis`: a wheel, a button."""
    edge = min(0.3 * radius, 0.6 * half_width)
    profile = [
        (0.02 * radius, -half_width),
        (radius - edge, -half_width),
        (radius, -half_width + edge),
        (radius, half_width - edge),
        (radius - edge, half_width),
        (0.02 * radius, half_width),
    ]
    return transform(lathe(profile, segments=20), frame_towards(axis), centre)


def turned(profile: list[tuple[float, float]], segments: int = 32) -> Solid:
    """`lathe` with corners kept: each inner row of the profile counts twice, so that shading leaves them sharp."""
    rows = np.asarray(profile, float)
    kept = [rows[0]]
    for before, here, after in zip(rows[:-2], rows[1:-1], rows[2:], strict=True):
        into, away = here - before, after - here
        step = 0.12 * min(np.linalg.norm(into), np.linalg.norm(away))
        kept += [here - unit(into) * step, here + unit(away) * step]
    kept.append(rows[-1])
    return lathe(np.array(kept), segments=segments)


def curve(points: ArrayLike, count: int) -> Array:
    """`count` points (count, 3) evenly spread on a smooth (Catmull-Rom) curve through the given ones."""
    points = np.asarray(points, float)
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = np.linspace(0, len(points) - 1 - 1e-9, count)
    k, u = t.astype(int), (t % 1)[:, None]
    p0, p1, p2, p3 = (padded[k + offset] for offset in range(4))
    return 0.5 * (2 * p1 + (p2 - p0) * u + (2 * p0 - 5 * p1 + 4 * p2 - p3) * u**2 + (3 * p1 - p0 - 3 * p2 + p3) * u**3)


def cone(foot: Array, tip: Array, radius: float, flatten: float = 1.0) -> Solid:
    """A pointed cone with straight sides."""
    share = np.linspace(0, 1, 5)[:, None]
    return tube(foot + share * (np.asarray(tip) - foot), radius * (1 - 0.93 * share[:, 0]), 12, flatten)
