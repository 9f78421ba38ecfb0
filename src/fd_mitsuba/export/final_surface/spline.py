"""A cubic spline through the values on a lattice: twice continuously differentiable, with its exact gradient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

_AT_ONCE = 1 << 15
"""Points that are looked up together: their rows of four coefficients stay in the cache."""


@dataclass(frozen=True)
class LatticeSpline:
    """A tricubic B-spline; make one with `through`.

    Attributes:
        coefficients: (z, y, x) float64, with a border of two around the values' own.
        origin: (3,) position of the first value.
        spacing: between values.
    """

    coefficients: np.ndarray
    origin: np.ndarray
    spacing: float

    @classmethod
    def through(cls, values: np.ndarray, origin: np.ndarray, spacing: float) -> LatticeSpline:
        """The spline through values (z, y, x) at `origin + spacing (x, y, z)`."""
        padded = np.pad(np.asarray(values, dtype=np.float64), 2, mode="edge")
        return cls(ndimage.spline_filter(padded, 3, mode="mirror"), np.asarray(origin, dtype=np.float64), spacing)

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (N,) and gradients (N, 3) at points (N, 3); beyond the lattice as on its border, with the gradient
        there."""
        values, gradients = np.empty(len(points)), np.empty((len(points), 3))
        for start in range(0, len(points), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            values[rows], gradients[rows] = self._at(points[rows])
        return values, gradients

    def _at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        last = np.array(self.coefficients.shape[::-1]) - 5.0  # the last value, in steps from the first
        place = ((points - self.origin) / self.spacing).clip(0, last)
        cell = np.minimum(np.floor(place), np.maximum(last - 1, 0)).astype(np.int64)
        (wx, wy, wz), (sx, sy, sz) = (rows.transpose(1, 2, 0) for rows in _weights(place - cell))
        flat = self.coefficients.reshape(-1)
        _, height, width = self.coefficients.shape
        # The four coefficients that count along an axis start one before the cell; the border shifts them by two.
        x, y, z = (cell + 1).T
        first = (z * height + y) * width + x
        value, gradient = np.zeros(len(points)), np.zeros((len(points), 3))
        for k in range(4):
            for j in range(4):
                four = flat[(first + (k * height + j) * width)[:, None] + np.arange(4)].T
                along, across = (four * wx).sum(axis=0), wz[k] * wy[j]
                value += across * along
                gradient[:, 0] += across * (four * sx).sum(axis=0)
                gradient[:, 1] += wz[k] * sy[j] * along
                gradient[:, 2] += sz[k] * wy[j] * along
        return value, gradient / self.spacing


def _weights(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (N, 3, 4) of the four B-splines at `t` (N, 3) in [0, 1], and their derivatives."""
    u = 1 - t
    weights = np.stack([u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3], axis=-1) / 6
    slopes = np.stack([-(u**2), 3 * t**2 - 4 * t, -3 * u**2 + 4 * u, t**2], axis=-1) / 2
    return weights, slopes
