"""What a ControlNet is shown of the surface, in closed form: a ball before a box that is seen from above."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from appearance_setup import WHITE, ball, blocks, shading

from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.render.surface_views import surface_views
from fd_mitsuba.scene.views import CameraBatch

SIZE, RADIUS, HEIGHT, FOV = 64, 0.35, 0.55, 40.0


@pytest.fixture(scope="module")
def gbuffer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GBuffer]:
    """From the front, level with the ball's middle, three units away from it."""
    scene = blocks(tmp_path_factory.mktemp("surface"), WHITE)
    rendering = AppearancePass(scene, {"part": ball(HEIGHT, RADIUS, 4)}, shading("diffuse"), SIZE, 4)
    camera = CameraBatch.around(np.array([0.0]), 0.0, 3.0, FOV, np.array([[0.0, HEIGHT, 0.0]]))
    yield rendering.trace(camera, seed=1)  # what was hit lives as long as the scene


def rays() -> tuple[np.ndarray, np.ndarray]:
    """x to the right and y up at depth 1 of every pixel's middle."""
    place = ((np.arange(SIZE) + 0.5) / SIZE * 2 - 1) * np.tan(np.radians(FOV / 2))
    x, y = np.meshgrid(place, -place)
    return x, y


def nearest() -> np.ndarray:
    """Depth z of the ball, NaN beside it: z^2 (x^2 + y^2) + (z - 3)^2 = r^2."""
    x, y = rays()
    a, b, c = 1 + x**2 + y**2, -6.0, 9 - RADIUS**2
    with np.errstate(invalid="ignore"):
        return (-b - np.sqrt(b**2 - 4 * a * c)) / (2 * a)


def test_depth_is_white_where_it_is_nearest(gbuffer: GBuffer) -> None:
    picture = surface_views(gbuffer, "depth")
    assert picture.shape == (1, 3, SIZE, SIZE) and picture[:, 0].equal(picture[:, 2])
    assert picture.max() == 1 and picture[0, 0, 0, 0] == 0, "nothing is black"
    seen, z = picture[0, 0].numpy(), nearest()
    x, y = rays()
    inner = np.hypot(x, y) * 3 < 0.8 * RADIUS
    ratio = seen[inner] * z[inner]
    assert ratio.std() < 0.005 * ratio.mean(), "inversely proportional to the depth"


def test_normals_are_red_to_the_left_green_above_blue_in_front(gbuffer: GBuffer) -> None:
    picture, z = surface_views(gbuffer, "normal")[0], nearest()
    x, y = rays()
    inner = np.hypot(x, y) * 3 < 0.8 * RADIUS
    normal = np.stack([x * z, y * z, 3 - z]) / RADIUS
    expected = np.stack([1 - normal[0], 1 + normal[1], 1 + normal[2]]) / 2
    assert np.abs(picture.numpy() - expected)[:, inner].max() < 0.03
    torch.testing.assert_close(picture[:, 0, 0], torch.tensor([0.5, 0.5, 1.0]))
    row, column = np.argwhere(inner).mean(0).astype(int)
    assert picture[0, row, column - 5] > 0.55 > 0.45 > picture[0, row, column + 5]
    assert picture[1, row - 5, column] > 0.55 > 0.45 > picture[1, row + 5, column]
