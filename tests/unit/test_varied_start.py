"""What a seed makes of a focal region as the start of a part."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.fields.varied_start import varied_start
from fd_mitsuba.scene.focal_region import FocalRegion

AXIS = np.linspace(-1, 1, 41)
POINTS = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 3)


def ellipsoid(*half: float, x: float = 0.0) -> np.ndarray:
    matrix = np.diag([*half, 1.0])
    matrix[0, 3] = x
    return FocalRegion("region", matrix).sdf(POINTS)


@pytest.mark.parametrize("variety", [0.3, 0.6, 1.0])
def test_a_start_stays_within_its_region_and_is_not_empty(variety: float) -> None:
    region = ellipsoid(0.6, 0.4, 0.3)
    for seed in range(12):
        start = varied_start(region, POINTS, variety, seed)
        assert start.dtype == np.float32 and (start <= region + 1e-6).all()
        assert (region - start).max() <= variety * region.max() + 1e-6
        assert 0.05 < (start > 0).sum() / (region > 0).sum() < 1


def test_seeds_differ_visibly_and_repeat() -> None:
    region = ellipsoid(0.6, 0.4, 0.3)
    starts = [varied_start(region, POINTS, 0.6, seed) > 0 for seed in range(6)]
    for one in range(6):
        assert np.array_equal(starts[one], varied_start(region, POINTS, 0.6, one) > 0)
        for other in range(one):
            common, either = (starts[one] & starts[other]).sum(), (starts[one] | starts[other]).sum()
            assert common / either < 0.9


def test_left_and_right_are_alike() -> None:
    left, right = (varied_start(ellipsoid(0.2, 0.4, 0.3, x=x), POINTS, 0.6, 3).reshape(41, 41, 41) for x in (-0.5, 0.5))
    assert np.allclose(left, right[::-1], atol=1e-5)


def test_nothing_is_varied_without_variety_or_room() -> None:
    region = ellipsoid(0.6, 0.4, 0.3)
    assert varied_start(region, POINTS, 0.0, 5) is region
    outside = region - 5
    assert varied_start(outside, POINTS, 0.6, 5) is outside
