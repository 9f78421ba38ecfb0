"""Pixels that can see an object against rays through all of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from fd_mitsuba.backend import startup

mi = startup.start()

from fd_mitsuba.render.cameras import FilmCameras  # noqa: E402
from fd_mitsuba.render.film_extent import hull_corners, pixels_within  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

SIZE, SAMPLES = 48, 9


def scene(seed: int, with_ball: bool = True) -> mi.Scene:
    """A thin box and a ball, wherever the seed puts them; the ball is no mesh."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    turn = mi.ScalarTransform4f().rotate((axis / np.linalg.norm(axis)).tolist(), float(rng.uniform(0, 360)))
    box = turn @ mi.ScalarTransform4f().scale([0.6, 0.02, 0.2])
    centre = rng.uniform(-0.5, 0.5, 3).tolist()
    content = {"a": {"type": "cube", "to_world": box}}
    content |= {"b": {"type": "sphere", "center": centre, "radius": 0.2}} if with_ball else {}
    return mi.load_dict({"type": "scene", **content}, optimize=False)


def pixels_that_see(scene: mi.Scene, views: FilmCameras) -> np.ndarray:
    """By rays through a lattice of places in every pixel, its border included."""
    steps = np.linspace(0, 1, SAMPLES)
    x, y = (steps[:, None] + np.arange(SIZE)).T.ravel(), (steps[:, None] + np.arange(SIZE)).T.ravel()
    column, row = np.meshgrid(x, y)
    found = []
    for view in range(views.count):
        film = mi.Point2f(column.ravel().astype(np.float32), row.ravel().astype(np.float32))
        seen = np.array(scene.ray_test(views.at(mi.UInt32(view)).ray(film))).reshape(SIZE, SAMPLES, SIZE, SAMPLES)
        found.append(view * SIZE**2 + np.flatnonzero(seen.any(axis=(1, 3))))
    return np.concatenate(found)


def cameras_of(seed: int) -> FilmCameras:
    """From far and near, the object in the picture's middle or over its border."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, 360, 4), rng.uniform(-30, 60, 4)
    return FilmCameras(CameraBatch.around(*angles, 3.0, 45.0, rng.uniform(-0.8, 0.8, (4, 3))), SIZE)


@pytest.mark.parametrize("seed", range(6))
def test_no_pixel_that_sees_something_is_left_out(seed: int) -> None:
    here, views = scene(seed), cameras_of(seed)
    given, seen = pixels_within(hull_corners(here), views), pixels_that_see(here, views)
    assert (np.diff(given) > 0).all() and given.max() < 4 * SIZE**2
    assert not set(seen) - set(given)


@pytest.mark.parametrize("seed", range(6))
def test_a_convex_object_has_hardly_more_pixels_than_see_it(seed: int) -> None:
    here, views = scene(seed, with_ball=False), cameras_of(seed)
    film = np.zeros((4, SIZE, SIZE), dtype=bool)
    film.ravel()[pixels_that_see(here, views)] = True
    around = binary_dilation(film, np.ones((1, 3, 3)), iterations=3)
    given = pixels_within(hull_corners(here), views)
    visible = film.any(axis=(1, 2))[given // SIZE**2]
    assert around.ravel()[given[visible]].all()


def test_a_camera_beside_the_object_leaves_nothing_out() -> None:
    here = scene(0)
    cameras = CameraBatch.around(np.zeros(2), np.zeros(2), 3.0, 45.0, np.zeros((2, 3)))
    beside = dataclasses.replace(cameras, position=np.array([[0.0, 0.0, 0.1], cameras.position[1]]))
    given = pixels_within(hull_corners(here), FilmCameras(beside, SIZE))
    assert (given[: SIZE**2] == np.arange(SIZE**2)).all() and len(given) < 1.5 * SIZE**2


def test_where_nothing_is_seen_there_is_still_something_to_trace() -> None:
    cameras = CameraBatch.around(np.zeros(1), np.zeros(1), 3.0, 20.0, np.array([[50.0, 0.0, 0.0]]))
    assert len(pixels_within(hull_corners(scene(0)), FilmCameras(cameras, SIZE))) == 2
    assert len(pixels_within(np.zeros((0, 3)), FilmCameras(cameras, SIZE))) == 2


def test_a_flat_object_has_an_extent() -> None:
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.3
    cameras = CameraBatch.around(np.zeros(1), np.zeros(1), 3.0, 45.0, np.zeros((1, 3)))
    given = pixels_within(square, FilmCameras(cameras, SIZE))
    side = 0.6 / (2 * 3.0 * np.tan(np.radians(22.5))) * SIZE
    assert side**2 < len(given) < (side + 5) ** 2
