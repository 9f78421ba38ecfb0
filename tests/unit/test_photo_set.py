"""Photographs: framing by a projection of its own, exposure by a plane under an even sky, grain by what is true."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.scene_file import ready_mitsuba
from fd_mitsuba.viewing import photo_set
from fd_mitsuba.viewing.denoising import denoised, has_denoiser
from fd_mitsuba.viewing.framed_camera import framed_camera, turned_cameras
from fd_mitsuba.viewing.photo_set import PhotoSet

SKY = np.array([0.2, 0.4, 0.8])


def projected(points: np.ndarray, camera) -> np.ndarray:
    """Image coordinates in [-1, 1], x right and y up."""
    right, up, back = (axis[0].astype(np.float64) for axis in camera.basis())
    offset = points - camera.position[0]
    return (
        np.stack([offset @ right, offset @ up], 1)
        / -(offset @ back)[:, None]
        / np.tan(np.radians(camera.fov_deg[0]) / 2)
    )


@pytest.mark.parametrize("azimuth", [30.0, 210.0])
def test_the_points_fill_the_frame_in_its_middle(azimuth: float) -> None:
    points = np.random.default_rng(0).normal(size=(200, 3)) * [0.5, 0.1, 0.2] + [3, 1, -2]
    seen = projected(points, framed_camera(points, azimuth, 16.0, 25.0, 0.8))
    low, high = seen.min(axis=0), seen.max(axis=0)
    assert np.abs(low + high).max() < 0.02 and np.abs([low, high]).max() == pytest.approx(0.8, abs=0.01)


def test_all_cameras_of_a_film_have_one_distance_and_see_everything() -> None:
    points = np.random.default_rng(1).normal(size=(200, 3)) * [0.5, 0.1, 0.2]
    cameras = turned_cameras(points, 6, 16.0, 25.0, 0.9)
    distances = [np.linalg.norm(camera.position - camera.target) for camera in cameras]
    assert np.ptp(distances) < 1e-5
    assert max(np.abs(projected(points, camera)).max() for camera in cameras) == pytest.approx(0.9, abs=1e-3)


@pytest.fixture(scope="module")
def ball() -> PhotoSet:
    mi = ready_mitsuba()
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": SKY.tolist()}}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    # Far from the ground, so that it hardly shades it: half a degree of the sky.
    place = mi.ScalarTransform4f().translate([0, 500, 0])
    shape = {"type": "sphere", "id": "ball", "to_world": place, "bsdf": black}
    scene = mi.load_dict({"type": "scene", "sky": sky, "ball": shape}, optimize=False)
    return PhotoSet.of(mi, scene, Normalisation(np.zeros(3), 1.0), 0.0)


@pytest.mark.parametrize("size", [128, 800])
def test_the_ground_is_exposed_as_paper_and_less_tinted_than_the_light(ball: PhotoSet, size: int) -> None:
    """A plane under an even sky sends its reflectance times the sky's radiance."""
    camera = framed_camera(np.array([[-1.0, 0, -1], [1, 0, 1]]), 30.0, 20.0, 25.0)
    exposure = ball.exposure(camera, size)
    shown = 0.6 * SKY * exposure
    assert shown @ [0.2126, 0.7152, 0.0722] == pytest.approx(0.8, rel=0.02)
    assert shown[2] / shown[0] == pytest.approx(4**0.2, rel=0.05)


def test_what_a_camera_sees_of_a_shape(ball: PhotoSet) -> None:
    corners = np.array(list(itertools.product((-1.0, 1.0), (499.0, 501.0), (-1.0, 1.0))))
    # A ball that fills 0.85 or less of a square has at most pi / 4 of its area; from below the ground nothing is seen.
    share = ball.share_seen(framed_camera(corners, 30.0, 20.0, 25.0, 0.85), ["ball"])
    assert 0.2 < share < np.pi / 4 * 0.85**2
    assert ball.share_seen(framed_camera(corners - [0, 600, 0], 30.0, 20.0, 25.0), ["ball"]) == 0


def test_without_a_denoiser_a_photograph_has_more_samples(ball: PhotoSet, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = framed_camera(np.array([[-1.0, 0, -1], [1, 0, 1]]), 30.0, 20.0, 25.0)
    monkeypatch.setattr(photo_set, "has_denoiser", lambda: False)
    assert np.array_equal(ball.photograph(camera, 16, 2), ball.radiance(camera, 16, 8))


def test_the_grain_of_a_pixel_is_not_that_of_its_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    """A denoiser keeps what pixels have in common: 0.16 and 0.12 of it, with seeds of portions that are near."""
    mi = ready_mitsuba()
    place = mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90)
    lamp = {"type": "rectangle", "to_world": place, "light": {"type": "area"}}
    shade = {"type": "sphere", "center": [0, 1.2, 0], "radius": 0.6}
    scene = mi.load_dict({"type": "scene", "lamp": lamp, "shade": shade}, optimize=False)
    photo = PhotoSet.of(mi, scene, Normalisation(np.zeros(3), 1.0), 0.0)
    monkeypatch.setattr(photo_set, "SAMPLES_AT_ONCE", 4 * 128**2)
    image = photo.radiance(framed_camera(np.array([[-1.0, 0, -1], [1, 0, 1]]), 30.0, 20.0, 25.0), 128, 16)[..., 1]
    grain = image - uniform_filter(image, 9)
    for columns in (1, 2):
        assert abs((grain[:, columns:] * grain[:, :-columns]).mean() / grain.var()) < 0.06


@pytest.mark.skipif(not has_denoiser(), reason="needs mitsuba-oidn")
def test_grain_goes_and_edges_stay() -> None:
    size = 96
    albedo = np.full((size, size, 3), 0.2, np.float32)
    albedo[:, size // 2 :] = 0.7
    truth = albedo * np.linspace(0.5, 3, size, dtype=np.float32)[:, None, None]
    noise = np.random.default_rng(0).gamma(4, 1 / 4, (size, size, 1)).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (size, size, 1))
    grainy = truth * noise
    grainy[3, 3] = np.nan
    clean = denoised(grainy, albedo, normal)
    assert np.isfinite(clean).all() and clean.min() >= 0
    before, after = (np.abs(image[8:-8, 8:-8] / truth[8:-8, 8:-8] - 1).mean() for image in (truth * noise, clean))
    assert before > 0.3 and after < 0.1
    edge = clean[8:-8, size // 2 - 1 : size // 2 + 1].mean(axis=(0, 2))
    assert edge[1] / edge[0] > 2.5  # 3.5 in truth, from one pixel to the next
