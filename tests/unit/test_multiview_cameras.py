"""Cameras as multi-view models are told them: known views, Mitsuba's own look-at, and groups around the object."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fd_mitsuba.config import CamerasConfig, RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.multiview import camera_conditions
from fd_mitsuba.scene.views import sample_views
from fd_mitsuba.training.step_views import check_views, step_views

X, Y, Z = np.eye(3)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "right", "up", "stands"),
    [
        (0, 0, X, Z, -Y),  # Blender's own front view
        (90, 0, Y, Z, X),  # and its right view: this package's +x is Blender's
        (180, 0, -X, Z, Y),
        (0, 90, X, Y, Z),  # its top view
        (90, -90, Y, X, -Z),
    ],
    ids=["front", "side", "back", "top", "below"],
)
def test_views_that_have_a_name_in_blender(
    azimuth: float, elevation: float, right: np.ndarray, up: np.ndarray, stands: np.ndarray
) -> None:
    matrix = camera_conditions([azimuth], [elevation]).view(4, 4).numpy()
    expected = np.stack([right, up, stands, stands], axis=1)
    np.testing.assert_allclose(matrix[:3], expected, atol=1e-7)
    assert matrix[3].tolist() == [0, 0, 0, 1]


def test_cameras_of_a_step_are_those_of_mitsuba_in_blenders_frame(mi: Any) -> None:
    """Mitsuba looks along +z with +x to the left; a translation of any length and target becomes one of length 1."""
    cameras = sample_views(CamerasConfig(), 8, seed=3, focus=(np.array([0.2, 0.5, -0.3]), 0.3))
    got = camera_conditions(cameras.azimuth_deg, cameras.elevation_deg).view(-1, 4, 4).numpy()
    to_blender = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    for index, matrix in enumerate(got):
        origin, target = cameras.position[index] - cameras.target[index], [0, 0, 0]
        mitsuba = mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target, up=[0, 1, 0])
        expected = to_blender @ np.array(mitsuba.matrix) @ np.diag([-1, 1, -1, 1])
        assert np.linalg.norm(expected[:3, 3]) == pytest.approx(CamerasConfig().radius, rel=1e-5)
        expected[:3, 3] /= np.linalg.norm(expected[:3, 3])
        np.testing.assert_allclose(matrix, expected, atol=1e-5)


def test_views_of_a_group_stand_evenly_around_the_object_at_one_height() -> None:
    guidance = SimpleNamespace(view_grid=1, views_together=4)
    cameras, _ = step_views(CamerasConfig(), 8, 5, (np.zeros(3), 1.0), np.zeros(3), guidance)
    for group in (slice(0, 4), slice(4, 8)):
        assert np.diff(cameras.azimuth_deg[group]) % 360 == pytest.approx([90.0] * 3, abs=1e-3)
        assert len(set(cameras.elevation_deg[group])) == len(set(cameras.fov_deg[group])) == 1
    assert cameras.elevation_deg[0] != cameras.elevation_deg[4]


@pytest.mark.parametrize("stage", ["geometry", "appearance"])
def test_views_that_do_not_fill_groups_are_one_line(stage: str) -> None:
    config = RunConfig.load(None, [f"{stage}.views=6", "guidance.model=folder"])
    with pytest.raises(UserError, match=rf"{stage}.views = 6: folder sees 4 views at once; .* multiple of 4"):
        check_views(stage, config, SimpleNamespace(view_grid=1, views_together=4))
