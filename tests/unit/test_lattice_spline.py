"""The spline through a lattice against functions of known value and slope."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.export.final_surface.spline import LatticeSpline

ORIGIN, SPACING, SHAPE = np.array([0.5, 0.2, -0.3]), 0.1, (20, 22, 24)


def lattice() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    z, y, x = np.meshgrid(
        *[np.arange(n) * SPACING + o for n, o in zip(SHAPE, ORIGIN[::-1], strict=True)], indexing="ij"
    )
    return x, y, z


def wave(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.sin(2 * x) + np.cos(1.5 * y) * z + x * y


def test_it_passes_through_the_values() -> None:
    values = np.random.default_rng(0).normal(size=SHAPE)
    points = np.stack(lattice(), axis=-1).reshape(-1, 3)
    assert LatticeSpline.through(values, ORIGIN, SPACING).at(points)[0] == pytest.approx(values.ravel(), abs=1e-12)


def test_values_and_gradients_of_a_smooth_function() -> None:
    points = np.random.default_rng(1).uniform([1.0, 0.7, 0.2], [2.3, 1.8, 1.1], (2000, 3))
    value, gradient = LatticeSpline.through(wave(*lattice()), ORIGIN, SPACING).at(points)
    x, y, z = points.T
    assert np.abs(value - wave(x, y, z)).max() < 2e-4
    exact = np.stack([2 * np.cos(2 * x) + y, -1.5 * np.sin(1.5 * y) * z + x, np.cos(1.5 * y)], axis=1)
    assert np.abs(gradient - exact).max() < 5e-3


def test_the_gradient_is_the_values_own_and_has_no_jump() -> None:
    spline = LatticeSpline.through(np.random.default_rng(2).normal(size=SHAPE), ORIGIN, SPACING)
    points = np.random.default_rng(3).uniform([0.8, 0.5, 0.0], [2.4, 1.9, 1.2], (500, 3))
    for axis, step in enumerate(1e-5 * np.eye(3)):
        slope = (spline.at(points + step)[0] - spline.at(points - step)[0]) / 2e-5
        assert slope == pytest.approx(spline.at(points)[1][:, axis], abs=1e-4 * np.abs(slope).max())
    x, y, z = (rows[4:-4, 4:-4, 4:-4] for rows in lattice())
    corners = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    ahead, behind = (spline.at(corners + 1e-7 * sign)[1] for sign in (1, -1))
    assert np.abs(ahead - behind).max() < 1e-3 * np.abs(ahead).max()


def test_beyond_the_lattice_it_is_as_on_its_border() -> None:
    spline = LatticeSpline.through(wave(*lattice()), ORIGIN, SPACING)
    inside, outside = np.array([[0.5, 1.0, 0.4]]), np.array([[-3.0, 1.0, 0.4]])
    assert spline.at(outside)[0] == pytest.approx(spline.at(inside)[0], abs=1e-12)
