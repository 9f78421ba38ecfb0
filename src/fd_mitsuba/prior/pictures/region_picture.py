"""Where a part may grow, as the shape priors are shown it: the outlines of rough ellipsoids around the part.

A run's focal regions say where a part is to be, and how large. A prior that sees them need not spread its answer over
all the places where such a part might sit. Like a user's, the ellipsoids of a training picture are larger than the part
or cut a little of it off, lie askew and beside its middle; nothing of the base hides them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.prior.data.primitives import Solid, rotation

UNTOLD_SHARE = 0.1
"""Pictures without any region, so that the prior can do without."""
_SIZES = 0.9, 1.6
"""Half axes over those of the part's box: an ellipsoid that holds the box has 1.73 times as long ones."""
_AXES_APART = 0.15
"""How much more one axis may be longer or shorter, as a logarithm."""
_OFF = 0.2
"""Of the middle, in half axes."""
_TILT_DEG = 15.0
_LEAST_HALF_AXIS = 0.06
_ALONG_SHARE, _HALVES_SHARE = 0.4, 0.5
_GAP = 0.02


@dataclass(frozen=True)
class Ellipsoid:
    """The image of the unit sphere under x -> `linear` x + `centre`, in the canonical frame."""

    centre: np.ndarray
    linear: np.ndarray

    def hit_by(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether rays (N, 3), (N, 3) that start outside meet it (N,)."""
        inverse = np.linalg.inv(self.linear)
        start, along = (origins - self.centre) @ inverse.T, directions @ inverse.T
        a, b = np.einsum("ij,ij->i", along, along), np.einsum("ij,ij->i", start, along)
        c = np.einsum("ij,ij->i", start, start) - 1
        return (b < 0) & (b * b > a * c)


def regions_around(part: Solid, rng: np.random.Generator) -> list[Ellipsoid]:
    """One ellipsoid around a part, or two where it is in two halves or is often drawn so."""
    points = part.vertices
    across = points[:, 0] - (points[:, 0].min() + points[:, 0].max()) / 2
    apart = np.abs(across).min() > _GAP or np.ptp(points[:, 0]) > 2 * np.ptp(points[:, 1:], axis=0).max() / 3
    halves = bool(apart and rng.random() < _HALVES_SHARE)
    groups = [points[across > 0], points[across <= 0]] if halves else [points]
    size = rng.uniform(*_SIZES)
    return [_around(group, size, rng) for group in groups if len(group)]


def regions_anywhere(body: Solid, rng: np.random.Generator) -> list[Ellipsoid]:
    """An ellipsoid somewhere on a body, in which nothing is asked for."""
    half = rng.uniform(0.1, 0.6) * np.exp(rng.uniform(-0.6, 0.6, 3))
    return [Ellipsoid(body.vertices[rng.integers(len(body.vertices))], rotation(*_tilt(rng)) * half)]


def region_picture(
    regions: list[Ellipsoid], origins: np.ndarray, directions: np.ndarray, view_size: int, samples: int
) -> np.ndarray:
    """(2 view_size, 2 view_size) int8 in units of 1/127: the share of each pixel of four views in which one is met.

    Args:
        origins, directions: (4 S S, 3) with S = view_size samples, as `corpus.MosaicCamera.rays` gives them.
    """
    met = np.zeros(len(origins), dtype=bool)
    for region in regions:
        met |= region.hit_by(origins, directions)
    share = met.reshape(4, view_size, samples, view_size, samples).mean((2, 4))
    mosaic = share.reshape(2, 2, view_size, view_size).transpose(0, 2, 1, 3).reshape(2 * view_size, 2 * view_size)
    return np.rint(mosaic * 127).astype(np.int8)


def _around(points: np.ndarray, size: float, rng: np.random.Generator) -> Ellipsoid:
    axes = np.eye(3)
    if rng.random() < _ALONG_SHARE and len(points) > 3:  # as one turns an ellipsoid along a horn
        axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2].T
    within = points @ axes
    middle, half = (within.min(0) + within.max(0)) / 2, np.ptp(within, axis=0) / 2
    half = np.maximum(half * size * np.exp(rng.uniform(-_AXES_APART, _AXES_APART, 3)), _LEAST_HALF_AXIS)
    centre = axes @ (middle + rng.uniform(-_OFF, _OFF, 3) * half)
    return Ellipsoid(centre, rotation(*_tilt(rng)) @ axes * half)


def _tilt(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-_TILT_DEG, _TILT_DEG, 3)
