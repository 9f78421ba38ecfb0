"""Rays at spheres that overlap, whose crossings are known."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_rays import TriangleRays

VERTICES, FACES = unit_sphere(4)
UP = np.array([0.0, 1.0, 0.0])
TWO = TriangleRays(np.concatenate([VERTICES[FACES], (VERTICES + [0, 1.2, 0])[FACES], (VERTICES + [0, 5, 0])[FACES]]))
OFF = np.array([0.0123, 0, 0.0071])


def test_the_first_crossing_is_the_nearest() -> None:
    below = TWO.first(OFF - 3 * UP, UP)
    assert below is not None and abs(below[1] + 1) < 0.01
    inside = TWO.first(OFF, UP)
    assert inside is not None and abs(inside[1] - 0.2) < 0.01  # the lower side of the second ball, within the first
    assert TWO.first(OFF + [3, 0, 0], UP) is None


def test_the_way_out_passes_what_overlaps_and_stops_at_a_gap() -> None:
    for height in (-0.9, 0.0, 0.5, 1.1):
        out = TWO.way_out(OFF + height * UP, UP)
        assert out is not None and abs(out[1] - 2.2) < 0.01
    down = TWO.way_out(OFF + 2.0 * UP, -UP)
    assert down is not None and abs(down[1] + 1) < 0.01
    assert TWO.way_out(OFF + 3 * UP, UP) is None and TWO.way_out(OFF + 9 * UP, UP) is None
