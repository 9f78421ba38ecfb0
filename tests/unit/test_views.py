from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fd_mitsuba.config import CamerasConfig
from fd_mitsuba.scene.views import CameraBatch, ring_views, sample_views, view_label

CAMERAS = CamerasConfig()


@pytest.mark.parametrize("count", [1, 4, 7])
def test_every_slice_of_azimuth_holds_one_camera(count: int) -> None:
    for seed in range(50):
        azimuth = sample_views(CAMERAS, count, seed).azimuth_deg
        assert np.array_equal(np.floor(azimuth / (360 / count) - 1e-6 * (azimuth > 0)).clip(0), np.arange(count))


def test_angles_and_fov_fill_their_ranges_and_nothing_else() -> None:
    views = sample_views(CAMERAS, 4000, seed=3)
    for values, (low, high) in ((views.elevation_deg, CAMERAS.elevation_deg), (views.fov_deg, CAMERAS.fov_deg)):
        assert low <= values.min() and values.max() <= high
        assert abs(values.mean() - (low + high) / 2) < 0.03 * (high - low)
    assert np.allclose(np.linalg.norm(views.position - views.target, axis=1), CAMERAS.radius, atol=1e-5)
    assert np.all(views.target == 0)


def test_same_seed_same_views_other_seed_other_views() -> None:
    first, again, other = (sample_views(CAMERAS, 4, seed) for seed in (7, 7, 8))
    assert np.array_equal(first.position, again.position) and np.array_equal(first.fov_deg, again.fov_deg)
    assert not np.array_equal(first.position, other.position)


def test_global_random_state_is_not_touched() -> None:
    before = np.random.get_state()[1].copy()
    sample_views(CAMERAS, 4, 0)
    assert np.array_equal(before, np.random.get_state()[1])


@pytest.mark.parametrize(
    ("azimuth", "elevation", "expected"),
    [(0, 0, (0, 0, 3)), (90, 0, (3, 0, 0)), (180, 0, (0, 0, -3)), (270, 0, (-3, 0, 0)), (0, 90, (0, 3, 0))],
)
def test_positions_follow_the_convention(azimuth: float, elevation: float, expected: tuple[float, ...]) -> None:
    view = CameraBatch.around(np.array([azimuth]), elevation, 3.0, 40.0)
    assert np.allclose(view.position[0], expected, atol=1e-6)


@settings(deadline=None, max_examples=200)
@given(azimuth=st.floats(-720, 720), elevation=st.floats(-90, 90))
def test_basis_is_orthonormal_right_handed_and_upright(azimuth: float, elevation: float) -> None:
    view = CameraBatch.around(np.array([azimuth]), elevation, 3.0, 40.0, np.array([[0.2, -0.1, 0.3]]))
    right, up, back = (axis[0].astype(np.float64) for axis in view.basis())
    axes = np.stack([right, up, back])
    assert np.allclose(axes @ axes.T, np.eye(3), atol=2e-6)
    assert np.isclose(np.linalg.det(axes), 1.0, atol=1e-5)
    assert np.allclose(np.cross(right, up), back, atol=2e-6)
    assert np.allclose(back, (view.position[0] - view.target[0]) / 3.0, atol=1e-5)
    assert up[1] >= -1e-6 and abs(right[1]) < 1e-5


def test_basis_of_the_front_view_is_the_world() -> None:
    right, up, back = ring_views(4, elevation_deg=0).basis()
    assert np.allclose(right[0], [1, 0, 0]) and np.allclose(up[0], [0, 1, 0]) and np.allclose(back[0], [0, 0, 1])
    assert np.allclose(right[1], [0, 0, -1], atol=1e-6)  # seen from +x, -z is to the right


@pytest.mark.parametrize(
    ("azimuth", "label"),
    [(0, "front"), (45, "front"), (46, "side"), (90, "side"), (135, "side"), (136, "back"), (180, "back"),
     (224, "back"), (226, "side"), (270, "side"), (314, "side"), (316, "front"), (-30, "front"), (725, "front")],
)  # fmt: skip
def test_view_label(azimuth: float, label: str) -> None:
    assert view_label(azimuth) == label


def test_ring_is_even_and_starts_at_the_front() -> None:
    ring = ring_views(8, elevation_deg=20, fov_deg=45, radius=3)
    assert np.allclose(ring.azimuth_deg, np.arange(8) * 45)
    assert ring.labels() == ["front", "front", "side", "side", "back", "side", "side", "front"]
    assert np.allclose(ring.position[:, 1], 3 * np.sin(np.radians(20)), atol=1e-6)
    assert len(ring) == 8


def test_focus_frames_the_ball_from_the_usual_distance() -> None:
    centre, radius = np.array([0.3, 0.4, -0.1]), 0.35
    views = sample_views(CAMERAS, 64, seed=1, focus=(centre, radius))
    assert np.allclose(views.target, centre)
    assert np.allclose(np.linalg.norm(views.position - views.target, axis=1), CAMERAS.radius, atol=1e-5)
    apparent = np.degrees(2 * np.arcsin(radius / CAMERAS.radius))
    assert np.all(views.fov_deg > 1.15 * apparent) and np.all(views.fov_deg < 1.7 * apparent)
    huge = sample_views(CAMERAS, 64, seed=1, focus=(centre, 10.0))
    assert np.array_equal(huge.fov_deg, sample_views(CAMERAS, 64, seed=1).fov_deg)


def test_jitter_moves_camera_and_target_together() -> None:
    views = sample_views(CamerasConfig(centre_jitter=0.2), 256, seed=5)
    assert 0.15 < np.abs(views.target).max() <= 0.2
    assert np.allclose(np.linalg.norm(views.position - views.target, axis=1), CAMERAS.radius, atol=1e-5)


def test_arrays_are_read_only() -> None:
    with pytest.raises(ValueError, match="read-only"):
        ring_views(4).position[0, 0] = 1.0
