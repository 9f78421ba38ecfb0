"""What a run starts from: smooth ellipsoids where a part is to grow, which the evaluator must not take for the part."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.primitives import Solid, ellipsoid, join, rotation
from fd_mitsuba.prior.pictures.colour_corpus import pieces_of

_LEAST_HALF, _MOST_HALF = 0.06, 0.8


def starts_like(part: Solid, rng: np.random.Generator) -> Solid:
    """Ellipsoids about the part as an artist draws focal regions: one for all, or for a pair one on each side."""
    pieces = pieces_of(part)
    centres = np.array([part.vertices[part.faces[pieces == k]].mean((0, 1)) for k in range(pieces.max() + 1)])
    side = np.sign(np.where(np.abs(centres[:, 0]) < 0.02, 0.0, centres[:, 0]))
    is_pair = (side > 0).any() and (side < 0).any() and not (side == 0).any()
    if not is_pair or rng.random() < 0.2:
        return _ellipsoid_about(part.vertices, rng)
    return join([_ellipsoid_about(part.vertices[part.faces[(side == s)[pieces]]].reshape(-1, 3), rng) for s in (-1, 1)])


def _ellipsoid_about(points: np.ndarray, rng: np.random.Generator) -> Solid:
    """Of the points' extent along the axes or along their own principal ones, turned, moved and resized a little."""
    axes = np.eye(3)
    if rng.random() < 0.6:
        axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2].T
        axes[:, 2] *= np.linalg.det(axes)
    low, high = (points @ axes).min(0), (points @ axes).max(0)
    half = np.clip((high - low) / 2 * rng.uniform(0.65, 1.15, 3), _LEAST_HALF, _MOST_HALF)
    centre = axes @ ((low + high) / 2 + 0.25 * half * rng.uniform(-1, 1, 3))
    return ellipsoid(centre, half, axes @ rotation(*rng.uniform(-15, 15, 3)))
