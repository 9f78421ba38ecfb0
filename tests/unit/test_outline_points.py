"""Points on outlines against the same in NumPy, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from plain_outline import plain_points

from fd_mitsuba.backend import startup

startup.start()

from fd_mitsuba.render.outline import Outline  # noqa: E402
from fd_mitsuba.render.outline_points import sample_outline  # noqa: E402


def outline(views: list[int], seed: int = 0) -> Outline:
    """Random edges of random lengths, some of length 0, as many in each view as the list says."""
    rng, count = np.random.default_rng(seed), sum(views)
    film = rng.random((count, 2, 2)) * 64
    film[::7, 1] = film[::7, 0]
    return Outline(
        np.repeat(np.arange(len(views)), views),
        rng.integers(0, 1000, (count, 2)),
        film,
        rng.random((count, 2)) + 0.5,
        np.sort(rng.random((count, 2)), axis=1),
        rng.standard_normal((count, 2)),
    )


@pytest.mark.parametrize("views", [[40, 0, 25], [8], [0, 3], [1000, 1000, 1000, 1000]])
def test_every_point_is_the_one_that_numpy_finds(views: list[int]) -> None:
    edges = outline(views)
    got, expected = sample_outline(edges, len(views), 300, seed=5), plain_points(edges, len(views), 300, seed=5)
    assert got is not None and len(got) == len(expected.view) == 300 * sum(count > 0 for count in views)
    for name in ("view", "along", "depth", "length"):
        np.testing.assert_array_equal(np.array(getattr(got, name)), np.float32(getattr(expected, name)), err_msg=name)
    for name in ("film", "outwards"):
        np.testing.assert_array_equal(np.array(getattr(got, name)).T, np.float32(getattr(expected, name)), err_msg=name)
    for end in (0, 1):
        np.testing.assert_array_equal(np.array(got.vertices[end]), expected.vertices[:, end])


def test_views_without_an_outline_have_no_points() -> None:
    edges = outline([0, 0])
    assert sample_outline(edges, 2, 100, seed=0) is None and not len(plain_points(edges, 2, 100, seed=0).view)
