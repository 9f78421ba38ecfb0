"""Silhouette edges on the film, against plain projections of many points along each of them."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.backend import startup

mi = startup.start()

from fd_mitsuba.backend.upload import upload_floats, upload_indices  # noqa: E402
from fd_mitsuba.render.cameras import FilmCameras  # noqa: E402
from fd_mitsuba.render.mesh_edges import MeshEdges  # noqa: E402
from fd_mitsuba.render.outline import clip_outline  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

SIZE, VIEWS, EDGES = 32, 3, 4000
FRACTIONS = (np.arange(400) + 0.5) / 400


@pytest.fixture(scope="module")
def cameras() -> FilmCameras:
    return FilmCameras(CameraBatch.around(np.array([0.0, 80.0, 190.0]), 25.0, 1.5, 50.0), SIZE)


@pytest.fixture(scope="module")
def triangles() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Loose triangles around and behind the cameras: vertices (3 E, 3), faces (E, 3), a view for each (E,)."""
    numbers = np.random.default_rng(0)
    corners = numbers.normal(0, 0.9, (EDGES, 1, 3)) + numbers.normal(0, 0.5, (EDGES, 3, 3))
    vertices = corners.reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(3 * EDGES).reshape(-1, 3), numbers.integers(0, VIEWS, EDGES)


def project(cameras: FilmCameras, view: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Film positions (..., 2) and depths (...) of points (S, ..., 3)."""
    offset = points - cameras.position[view].reshape(len(view), *[1] * (points.ndim - 2), 3)
    seen = np.einsum("sij,s...j->s...i", cameras.axes[view], offset)
    depth = -seen[..., 2]
    width = cameras.half_width[view].reshape(len(view), *[1] * (points.ndim - 2))
    flat = seen[..., :2] * ([1, -1] * np.ones(2)) / (depth * width)[..., None]
    return SIZE / 2 * (1 + flat), depth


def test_what_is_left_of_an_edge_is_what_is_in_the_picture(cameras: FilmCameras, triangles: tuple) -> None:
    vertices, faces, view = triangles
    edges = MeshEdges(np.arange(0, 3 * EDGES, 3), np.full(EDGES, -1))
    outline = clip_outline(view, edges, upload_floats(vertices), upload_indices(faces), cameras)
    assert (np.diff(outline.view) >= 0).all() and 500 < len(outline.view) < EDGES

    ends = vertices[outline.vertices].astype(np.float64)
    places = ends[:, :1] + outline.along[..., None] * (ends[:, 1:] - ends[:, :1])
    film, depth = project(cameras, outline.view, places)
    assert film == pytest.approx(outline.film, abs=1e-5) and depth == pytest.approx(outline.depth, rel=1e-5)
    assert outline.film.min() > -1e-6 and outline.film.max() < SIZE + 1e-6

    # Of every edge, dropped ones included: what is in the picture is between the ends, what is not is not.
    every = vertices.reshape(-1, 3, 3).astype(np.float64)
    points = every[:, :1] + FRACTIONS[:, None] * (every[:, 1:2] - every[:, :1])
    film, depth = project(cameras, view, points)
    shown = (depth > 1e-3) & ((film > 0) & (film < SIZE)).all(-1)
    along = np.full((EDGES, 2), 2.0)
    along[outline.vertices[:, 0] // 3] = outline.along
    assert (shown == ((FRACTIONS > along[:, :1]) & (FRACTIONS < along[:, 1:]))).mean() > 0.9999


def test_outwards_is_across_the_edge_and_away_from_the_surface(cameras: FilmCameras, triangles: tuple) -> None:
    vertices, faces, view = triangles
    edges = MeshEdges(np.arange(0, 3 * EDGES, 3), np.full(EDGES, -1))
    outline = clip_outline(view, edges, upload_floats(vertices), upload_indices(faces), cameras)
    assert np.linalg.norm(outline.outwards, axis=1) == pytest.approx(np.ones(len(outline.view)))
    step = outline.film[:, 1] - outline.film[:, 0]
    long = np.linalg.norm(step, axis=1) > 0.1
    step = step[long] / np.linalg.norm(step[long], axis=1)[:, None]
    assert np.abs((step * outline.outwards[long]).sum(1)).max() < 1e-3
    third, depth = project(cameras, outline.view, vertices[outline.vertices[:, 1] + 1].astype(np.float64))
    inwards = ((third - outline.film[:, 0]) * outline.outwards).sum(1)
    assert (inwards[long & (depth > 0.01)] < 0).all()


@pytest.mark.parametrize(("height", "left"), [(0.2, 1), (-0.2, 0)])
def test_only_folds_that_bend_outwards_are_left(cameras: FilmCameras, height: float, left: int) -> None:
    """Two faces beside a level edge at `height`, their other corners at 0: a roof or a gutter."""
    roof = np.array([[-0.2, height, 0], [0.2, height, 0], [0, 0, -0.3], [0, 0, 0.3]], np.float32)
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    edges = MeshEdges(np.array([0]), np.array([3]))
    outline = clip_outline(np.zeros(1, int), edges, upload_floats(roof), upload_indices(faces), cameras)
    assert len(outline.view) == left and outline.film.shape == (left, 2, 2)


def test_no_edges_are_no_outline(cameras: FilmCameras) -> None:
    nothing = np.zeros(0, int)
    found = clip_outline(nothing, MeshEdges(nothing, nothing), mi.Float(), mi.UInt32(), cameras)
    assert found.film.shape == (0, 2, 2) and found.outwards.shape == (0, 2) and found.view.dtype == int
