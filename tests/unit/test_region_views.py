"""Where focal regions are seen, against the closed form of a ball in perspective and against what hides what."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.scene_file import ready_mitsuba
from fd_mitsuba.scene.views import CameraBatch

ready_mitsuba()

from fd_mitsuba.render.region_views import RegionViews  # noqa: E402

SIZE, DISTANCE, FOV = 48, 3.0, 40.0


def ball(name: str, centre: tuple[float, float, float], radius: float) -> FocalRegion:
    matrix = np.diag([radius, radius, radius, 1.0])
    matrix[:3, 3] = centre
    return FocalRegion(name, matrix, part=name)


def cameras(*azimuths: float) -> CameraBatch:
    return CameraBatch.around(np.array(azimuths), 0.0, DISTANCE, FOV)


@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_a_ball_covers_the_disc_that_perspective_makes_of_it(margin: float) -> None:
    masks = RegionViews({"ball": [ball("ball", (0, 0, 0), 0.4)]}, SIZE, margin).render(cameras(0, 90), seed=1)
    radius = 0.4 + margin
    disc = radius / (DISTANCE**2 - radius**2) ** 0.5 / np.tan(np.radians(FOV / 2)) * SIZE / 2
    assert masks["ball"].shape == (2, 1, SIZE, SIZE)
    for mask in masks["ball"]:
        assert abs(float(mask.sum()) / (np.pi * disc**2) - 1) < 0.02
        row, column = np.indices((SIZE, SIZE))
        away = np.hypot(row + 0.5 - SIZE / 2, column + 0.5 - SIZE / 2)
        inside, outside = torch.from_numpy(away < disc - 1), torch.from_numpy(away > disc + 1)
        assert (mask[0][inside] == 1).all() and (mask[0][outside] == 0).all()


def test_the_nearest_region_has_the_pixel() -> None:
    """Two balls of one size, one behind the other: the camera's own is seen, but for a rim of the smaller one."""
    parts = {"front": [ball("front", (0, 0, 0.5), 0.3)], "back": [ball("back", (0, 0, -0.5), 0.3)]}
    masks = RegionViews(parts, SIZE).render(cameras(0, 180, 90), seed=1)
    front, back = masks["front"].sum((1, 2, 3)), masks["back"].sum((1, 2, 3))
    assert back[0] == 0 and front[1] == 0, "hidden wholly: perspective makes the farther ball smaller"
    assert front[0] > 100 and back[1] > 100
    torch.testing.assert_close(front[2], back[2], rtol=0.05, atol=0)
    assert all((masks["front"] + masks["back"]).flatten() <= 1 + 1e-6)


def test_regions_of_one_part_are_one() -> None:
    apart = [ball("left", (-0.4, 0, 0), 0.2), ball("right", (0.4, 0, 0), 0.2)]
    together = RegionViews({"pair": apart}, SIZE).render(cameras(0), seed=1)["pair"]
    alone = [RegionViews({"one": [region]}, SIZE).render(cameras(0), seed=1)["one"] for region in apart]
    torch.testing.assert_close(together, alone[0] + alone[1])
