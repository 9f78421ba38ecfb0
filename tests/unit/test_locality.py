"""Inside and overlap fractions of balls, whose volumes are known."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.runs.locality import Locality, measure_locality
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.tessellate import unit_sphere

Mesh = tuple[np.ndarray, np.ndarray]
SAMPLES = 48


def ball(radius: float, x: float = 0.0) -> Mesh:
    vertices, faces = unit_sphere(4)
    return vertices * radius + np.array([x, 0.0, 0.0]), np.array(faces)


def region(radius: float, x: float = 0.0) -> FocalRegion:
    matrix = np.diag([radius, radius, radius, 1.0])
    matrix[0, 3] = x
    return FocalRegion("region", matrix)


def lens(a: float, b: float, distance: float) -> float:
    """Volume shared by two balls of radius a and b, |a - b| < distance < a + b."""
    sides = distance**2 + 2 * distance * (a + b) - 3 * (a - b) ** 2
    return np.pi * (a + b - distance) ** 2 * sides / (12 * distance)


def volume(radius: float) -> float:
    return 4 / 3 * np.pi * radius**3


@pytest.mark.parametrize("distance", [0.3, 0.5, 0.7])
def test_overlap_of_two_balls(distance: float) -> None:
    result = measure_locality(ball(0.3, distance), ball(0.5), (region(1.0),), 0.0, SAMPLES)
    assert result.part_volume == pytest.approx(volume(0.3), rel=0.01)
    assert result.overlap_fraction == pytest.approx(lens(0.3, 0.5, distance) / volume(0.3), abs=0.01)
    assert result.inside_fraction == 1.0


@pytest.mark.parametrize("band", [0.0, 0.05, 0.15])
def test_inside_counts_the_free_band(band: float) -> None:
    result = measure_locality(ball(0.4), ball(0.1, 3.0), (region(0.2),), band, SAMPLES)
    assert result.inside_fraction == pytest.approx(volume(0.2 + band) / volume(0.4), abs=0.005)
    assert result.overlap_fraction == 0.0


def test_several_regions_count_together() -> None:
    regions = (region(0.25, -0.2), region(0.25, 0.2))
    result = measure_locality(ball(0.6), ball(0.1, 3.0), regions, 0.0, SAMPLES)
    both = 2 * volume(0.25) - lens(0.25, 0.25, 0.4)
    assert result.inside_fraction == pytest.approx(both / volume(0.6), abs=0.005)


def test_scale_and_place_do_not_matter() -> None:
    one = measure_locality(ball(0.3, 0.5), ball(0.5), (region(0.4, 0.5),), 0.0, SAMPLES)
    (part, faces), (base, base_faces) = ball(0.3, 0.5), ball(0.5)
    far = region(4.0, 5.0 + 100.0)
    ten = measure_locality(
        (part * 10 + [100, 0, 0], faces), (base * 10 + [100, 0, 0], base_faces), (far,), 0.0, SAMPLES
    )
    assert ten.overlap_fraction == pytest.approx(one.overlap_fraction, abs=0.005)
    assert ten.part_volume == pytest.approx(1000 * one.part_volume, rel=0.01)


def test_nothing_counts_as_nothing() -> None:
    nothing = Locality(0.0, 0.0, 0.0)
    no_faces = (np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    flat = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    point = (np.zeros((3, 3)), np.array([[0, 1, 2]]))
    for part in (no_faces, flat, point):
        assert measure_locality(part, ball(0.5), (region(0.5),), 0.0) == nothing
