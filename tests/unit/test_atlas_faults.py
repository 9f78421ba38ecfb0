"""Measured faults of atlases that were spoilt on purpose: the figures are those that were put in."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.evaluation.atlas_faults import filtered, foreign_colour, mip_level, seam_edges, seam_jumps

SIZE = 64
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
SIDES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.fixture
def tetrahedron() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces, UVs: every face is a chart in a quarter of the picture of its own."""
    vertices, faces = CORNERS[SIDES].reshape(-1, 3), np.arange(12).reshape(-1, 3)
    triangle = np.array([[0.1, 0.1], [0.4, 0.1], [0.1, 0.4]])
    uv = np.concatenate([triangle + [x, y] for y in (0.0, 0.5) for x in (0.0, 0.5)])
    return vertices, faces, uv


def grey(points: np.ndarray) -> np.ndarray:
    return np.full((len(points), 3), 100.0)


def test_a_chart_of_another_colour_is_a_jump(tetrahedron: tuple[np.ndarray, ...]) -> None:
    picture = np.full((SIZE, SIZE, 3), 100.0)
    assert seam_jumps(*tetrahedron, picture, grey) == {"seams": 6, "jump": 0.0, "own": 0.0, "beyond_own": 0.0}
    picture[: SIZE // 2, : SIZE // 2, 1] = 107.0
    found = seam_jumps(*tetrahedron, picture, grey)
    assert found["jump"] == found["beyond_own"] == pytest.approx(7.0)


def test_what_the_field_does_itself_is_taken_off(tetrahedron: tuple[np.ndarray, ...]) -> None:
    picture = np.full((SIZE, SIZE, 3), 100.0)
    picture[: SIZE // 2, : SIZE // 2] = 107.0
    steep = seam_jumps(*tetrahedron, picture, lambda points: 1000.0 * points)
    assert steep["jump"] == pytest.approx(7.0) and steep["own"] > 7.0 and steep["beyond_own"] == 0.0


def test_a_background_shows_in_small_levels_only(tetrahedron: tuple[np.ndarray, ...]) -> None:
    """Black from four texels beside the charts on: nothing at full size, a lot where texels are eight times as wide."""
    rows, columns = (np.mgrid[0:SIZE, 0:SIZE] + 0.5) % (SIZE // 2)
    near = (rows > 2) & (columns > 2) & (rows + columns < 38)
    picture = np.where(near[..., None], 100.0, 0.0) * np.ones(3)
    assert foreign_colour(*tetrahedron, picture, grey, level=0)["stray"] == 0.0
    assert foreign_colour(*tetrahedron, picture, grey, level=3)["stray"] > 10
    assert foreign_colour(*tetrahedron, np.full_like(picture, 100.0), grey, level=3)["stray"] < 1e-9


def test_levels_are_means_of_light() -> None:
    checks = np.indices((8, 8)).sum(axis=0)[..., None] % 2 * 255.0 * np.ones(3)
    assert np.allclose(mip_level(checks, 3), 187.5, atol=0.1)  # half of white's light
    assert np.allclose(filtered(checks, np.array([[0.125, 0.0625], [0.0625, 0.0625]])), [[127.5] * 3, [0] * 3])


def test_an_open_mesh_is_refused(tetrahedron: tuple[np.ndarray, ...]) -> None:
    vertices, faces, uv = tetrahedron
    with pytest.raises(ValueError, match="not closed"):
        seam_edges(vertices, faces[1:], uv)
