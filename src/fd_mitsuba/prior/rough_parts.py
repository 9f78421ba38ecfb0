"""What stands where a part is to grow before it has its shape: the states that a run's surface passes through.

A run starts from ellipsoids and its surface is smooth until late. A denoiser that has only seen finished parts takes
such a lump at low noise for the truth; one that has seen lumps under noise, too, says what they ought to become.
"""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.primitives import Array, Solid, ellipsoid, join, rotation

Rng = np.random.Generator


def rough_part(part: Solid, rng: Rng) -> Solid:
    """Lumps where the part is; the swollen part; or the part that comes out of smaller lumps.

    Most lumps are as large as a region must be for the part to lie in it: the corners of a box reach the surface of an
    ellipsoid 1.7 times as long as the box in every direction.

    Args:
        part: closed, outward.
    """
    kind = rng.random()
    if kind < 0.55:
        return lumps(part, rng, *((0.95, 1.7) if rng.random() < 0.75 else (0.35, 0.95)))
    swollen = _swollen(part, rng)
    return swollen if kind < 0.75 else join([swollen, lumps(part, rng, 0.4, 0.9)])


def lumps(part: Solid, rng: Rng, least: float, most: float) -> Solid:
    """An ellipsoid for each side of a part in two halves, or one for all: along the axes or along the part.

    Args:
        least, most: their size as a share of the part's.
    """
    points = part.vertices
    sides = points[:, 0] > 0
    apart = sides.any() and not sides.all() and (np.abs(points[:, 0]).min() > 0.02 or rng.random() < 0.3)
    return join([_lump(group, rng, least, most) for group in ([points[sides], points[~sides]] if apart else [points])])


def _lump(points: Array, rng: Rng, least: float, most: float) -> Solid:
    middle = points.mean(0)
    axes = np.eye(3)
    if rng.random() < 0.6:
        axes = np.linalg.svd(points - middle, full_matrices=False)[2].T
        axes = axes * np.sign(np.linalg.det(axes))
    along = (points - middle) @ axes
    low, high = along.min(0), along.max(0)
    half = np.maximum((high - low) / 2 * rng.uniform(least, most, 3), 0.04)
    shift = (high - low) * rng.uniform(-0.12, 0.12, 3)
    turn = rotation(*rng.uniform(-12, 12, 3)) @ axes
    return ellipsoid(middle + axes @ ((low + high) / 2 + shift), half, turn)


def _swollen(part: Solid, rng: Rng) -> Solid:
    """The part with all its vertices moved outward, by up to an eighth of its size."""
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    total = np.zeros_like(part.vertices)
    for corner in range(3):
        np.add.at(total, part.faces[:, corner], face)
    normal = total / (np.linalg.norm(total, axis=1, keepdims=True) + 1e-20)
    size = np.ptp(part.vertices, axis=0).max()
    return Solid(part.vertices + normal * (size * rng.uniform(0.02, 0.12)), part.faces)
