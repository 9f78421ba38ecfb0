"""Closed triangle meshes from parametric shapes: what the prior's bodies and parts are put together from.

Every function returns a `Solid` with outward winding. Solids are concatenated, not merged: a ray sees the outermost
surface, and that is all that the training pictures need.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

Array = np.ndarray


class Solid(NamedTuple):
    """A closed mesh: vertices (V, 3) float64 and faces (F, 3) int64, counter-clockwise seen from outside."""

    vertices: Array
    faces: Array


def join(solids: list[Solid]) -> Solid:
    """One mesh that holds all the given ones side by side."""
    offsets = np.cumsum([0] + [len(s.vertices) for s in solids[:-1]])
    return Solid(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate([s.faces + o for s, o in zip(solids, offsets, strict=True)]),
    )


def mirror_x(solid: Solid) -> Solid:
    """The mirror image in the plane x = 0, still wound outward."""
    return Solid(solid.vertices * (-1.0, 1.0, 1.0), solid.faces[:, ::-1])


def rotation(degrees_x: float = 0.0, degrees_y: float = 0.0, degrees_z: float = 0.0) -> Array:
    """The 3x3 rotation about x, then y, then z."""
    cx, cy, cz = np.cos(np.deg2rad([degrees_x, degrees_y, degrees_z]))
    sx, sy, sz = np.sin(np.deg2rad([degrees_x, degrees_y, degrees_z]))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def transform(solid: Solid, linear: Array | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)) -> Solid:
    """The solid under x -> linear x + shift; the determinant must be positive."""
    vertices = solid.vertices if linear is None else solid.vertices @ np.asarray(linear, float).T
    return Solid(vertices + np.asarray(shift, float), solid.faces)


def sweep(centres: Array, across: Array, along: Array, segments: int = 14, exponent: float = 1.0) -> Solid:
    """A closed skin over rings centre + c across + s along, with (c, s) on a (super)circle; both ends are fan-capped.

    Args:
        centres: (n, 3) ring centres.
        across, along: (n, 3) half-axes of each ring; across x along must point along the path.
        segments: vertices a ring.
        exponent: 1 gives ellipses, below 1 boxy rings.
    """
    centres, across, along = (np.asarray(a, float) for a in (centres, across, along))
    angles = np.arange(segments) * (2 * np.pi / segments)
    cosine, sine = (np.sign(f) * np.abs(f) ** exponent for f in (np.cos(angles), np.sin(angles)))
    count = len(centres)
    rings = centres[:, None] + cosine[None, :, None] * across[:, None] + sine[None, :, None] * along[:, None]
    here = (np.arange(count - 1)[:, None] * segments + np.arange(segments)[None]).ravel()
    beside = (np.arange(count - 1)[:, None] * segments + (np.arange(segments)[None] + 1) % segments).ravel()
    above, above_beside = here + segments, beside + segments
    side = np.concatenate([np.stack([here, beside, above_beside], 1), np.stack([here, above_beside, above], 1)])
    first, last = count * segments, count * segments + 1
    ring, ring_next = np.arange(segments), (np.arange(segments) + 1) % segments
    top = (count - 1) * segments
    caps = np.concatenate(
        [
            np.stack([ring_next, ring, np.full(segments, first)], 1),
            np.stack([top + ring, top + ring_next, np.full(segments, last)], 1),
        ]
    )
    vertices = np.concatenate([rings.reshape(-1, 3), centres[:1], centres[-1:]])
    return Solid(vertices, np.concatenate([side, caps]))


def tube(points: ArrayLike, radii: ArrayLike, segments: int = 12, flatten: float = 1.0) -> Solid:
    """A round tube through points (n, 3) with radii (n,), rounded at both ends; `flatten` scales it across the path."""
    points, radii = np.asarray(points, float), np.asarray(radii, float)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True) + 1e-12
    steps = (0.55, 0.85)
    start = [points[0] - tangents[0] * radii[0] * s for s in reversed(steps)]
    end = [points[-1] + tangents[-1] * radii[-1] * s for s in steps]
    end_radii = [np.sqrt(1 - s * s) for s in steps]
    centres = np.concatenate([start, points, end])
    radii = np.concatenate([[radii[0] * r for r in reversed(end_radii)], radii, [radii[-1] * r for r in end_radii]])
    tangents = np.concatenate([tangents[:1]] * 2 + [tangents] + [tangents[-1:]] * 2)
    helper = np.eye(3)[np.argmin(np.abs(tangents).mean(0))]
    across = np.cross(helper, tangents)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(tangents, across)
    return sweep(centres, across * radii[:, None], along * radii[:, None] * flatten, segments)


def ellipsoid(centre: ArrayLike, half_axes: ArrayLike, turn: Array | None = None, exponent: float = 1.0) -> Solid:
    """An ellipsoid, or with `exponent` below 1 a rounded box, about its centre with half-axes (3,)."""
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, 13)[1:-1]
    height = np.sign(np.sin(latitudes)) * np.abs(np.sin(latitudes)) ** exponent
    width = np.abs(np.cos(latitudes)) ** exponent
    height, width = np.concatenate([[-1], height, [1]]), np.concatenate([[1e-3], width, [1e-3]])
    zero = np.zeros_like(height)
    unit = sweep(
        np.stack([zero, height, zero], 1),
        np.stack([zero, zero, width], 1),
        np.stack([width, zero, zero], 1),
        16,
        exponent,
    )
    linear = np.diag(np.asarray(half_axes, float))
    return transform(unit, linear if turn is None else turn @ linear, centre)


def box(centre: ArrayLike, half_axes: ArrayLike, turn: Array | None = None) -> Solid:
    """A box with slightly rounded edges."""
    return ellipsoid(centre, half_axes, turn, exponent=0.25)


def lathe(profile: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), segments: int = 24) -> Solid:
    """A solid of revolution about y through `centre`; profile rows are (radius, y) from the bottom to the top."""
    radius, height = np.asarray(profile, float).T
    zero = np.zeros_like(radius)
    rings = sweep(
        np.stack([zero, height, zero], 1),
        np.stack([zero, zero, radius], 1),
        np.stack([radius, zero, zero], 1),
        segments,
    )
    return transform(rings, shift=centre)
