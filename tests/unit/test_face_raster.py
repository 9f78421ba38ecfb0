"""Faces drawn one by one: the same hits as a ray tracer, whatever the size and the place of the faces."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
import trimesh

from fd_mitsuba.backend import startup

mi = startup.start()

from fd_mitsuba.backend.upload import upload_floats, upload_indices  # noqa: E402
from fd_mitsuba.render.cameras import FilmCameras  # noqa: E402
from fd_mitsuba.render.mesh_tracer import Hit, MeshTracer  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

SIZE, PER_VIEW = 32, 4000
Arrays = tuple[np.ndarray, np.ndarray]


def balls(fine: int, distance: float = 0.45) -> Arrays:
    """A coarse ball, and one of `20 4^fine` faces that goes through it."""
    first, second = trimesh.creation.icosphere(2, 0.5), trimesh.creation.icosphere(fine, 0.3)
    vertices = np.concatenate([first.vertices, second.vertices + (distance, 0.1, 0.2)])
    return vertices.astype(np.float32), np.concatenate([first.faces, second.faces + len(first.vertices)])


def loose(count: int, spread: float, length: float) -> Arrays:
    """Triangles anywhere, in any position, some of them slivers."""
    numbers = np.random.default_rng(count)
    shape = numbers.normal(0, length, (count, 3, 3))
    shape[::3, 2] = shape[::3, 1] + numbers.normal(0, 1e-3 * length, shape[::3, 2].shape)
    corners = numbers.normal(0, spread, (count, 1, 3)) + shape
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count).reshape(-1, 3)


def compare(
    vertices: np.ndarray, faces: np.ndarray, static_faces: int, radius: float = 3.0, from_outside: bool = False
) -> tuple[float, Hit, Hit]:
    """The share of film points at which both ways agree about the face or its depth, and both hits."""
    cameras = FilmCameras(CameraBatch.around(np.array([0.0, 70.0, 200.0]), 20.0, radius, 45.0), SIZE)
    numbers = np.random.default_rng(1)
    film = numbers.uniform(0, SIZE, (2, 3 * PER_VIEW)).astype(np.float32)
    film[:, :4] = [[0, SIZE, -1e-5, SIZE + 1e-5], [0, SIZE, 5, 5]]
    points, view = mi.Point2f(*(upload_floats(row) for row in film)), upload_indices(np.arange(3).repeat(PER_VIEW))
    tracer = MeshTracer()
    tracer.set_mesh(vertices, faces, static_faces)
    seen = tracer.draw(cameras, points, view, (upload_floats(vertices), upload_indices(faces)), from_outside)
    traced = tracer.trace(cameras.at(view).ray(points), coherent=False)
    both = np.array(seen.seen) & np.array(traced.seen)
    with np.errstate(invalid="ignore"):
        near = np.abs(np.array(seen.depth) - np.array(traced.depth)) < 1e-5 * np.array(traced.depth)
    nothing = ~np.array(seen.seen) & ~np.array(traced.seen)
    same_face = np.array(seen.face) == np.array(traced.face)
    weights = np.array(seen.uv)[:, both & same_face] - np.array(traced.uv)[:, both & same_face]
    assert not weights.size or np.quantile(np.abs(weights), 0.99) < 1e-3
    return float((nothing | (both & (same_face | near))).mean()), seen, traced


@pytest.mark.parametrize(
    ("mesh", "static_faces", "radius"),
    [
        (balls(4), 320, 3.0),  # tiny faces in front of, behind, and within kept ones
        (balls(4), 0, 3.0),
        (balls(5), 320, 1.2),  # near
        (balls(0), 320, 0.62),  # a few faces cover much of the picture, or reach behind the camera
        (loose(3000, 0.4, 0.02), 0, 3.0),
        (loose(3000, 0.4, 0.02), 1000, 3.0),
        (loose(300, 0.5, 0.4), 20, 1.0),  # around the camera: through its plane, beside it, behind it
        (loose(60, 3.0, 3.0), 0, 3.0),  # half a picture each
        (loose(40, 0.1, 1e-5), 0, 3.0),  # smaller than the distance between points
    ],
)
def test_the_same_as_the_ray_tracer(mesh: Arrays, static_faces: int, radius: float) -> None:
    agreement, seen, traced = compare(*mesh, static_faces, radius)
    assert agreement >= 0.999
    assert np.array(traced.seen).sum() > 0.02 * 3 * PER_VIEW or mesh[0].std() < 0.2


@pytest.mark.parametrize(("mesh", "static_faces", "radius"), [(balls(4), 0, 3.0), (balls(5), 0, 1.2)])
def test_the_backs_of_closed_meshes_need_not_be_drawn(mesh: Arrays, static_faces: int, radius: float) -> None:
    assert compare(*mesh, static_faces, radius, from_outside=True)[0] >= 0.999
    inside_out = mesh[0], mesh[1][:, ::-1]
    assert compare(*inside_out, static_faces, radius, from_outside=True)[0] < 0.9  # backs are indeed left out


def test_nothing_is_seen_of_what_lies_behind_every_camera() -> None:
    vertices, faces = loose(500, 0.05, 0.02)
    cameras = FilmCameras(CameraBatch.around(np.array([0.0]), 0.0, 3.0, 45.0), SIZE)
    tracer = MeshTracer()
    vertices[:, 2] += 6
    tracer.set_mesh(vertices, faces)
    centre = mi.Point2f(upload_floats(np.full(8, 16.0)), upload_floats(np.linspace(15, 17, 8)))
    mesh = (upload_floats(vertices), upload_indices(faces))
    assert not dr.any(tracer.draw(cameras, centre, upload_indices(np.zeros(8)), mesh).seen)


def test_other_numbers_of_faces_compile_nothing() -> None:
    """Large ones among them or not, more and fewer static ones."""
    small, large = loose(700, 0.4, 0.02), loose(60, 1.0, 2.0)
    compare(*small, 10)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        for mesh, static in ((large, 10), (loose(701, 0.4, 0.02), 10), (loose(2000, 0.3, 0.01), 700), (small, 11)):
            assert compare(*mesh, static)[0] >= 0.999
        assert sum(not entry["cache_hit"] for entry in dr.kernel_history() if "cache_hit" in entry) == 0
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)


def test_large_faces_of_an_earlier_mesh_are_forgotten() -> None:
    cameras = FilmCameras(CameraBatch.around(np.array([0.0]), 0.0, 3.0, 45.0), SIZE)
    numbers = np.random.default_rng(3).uniform(0, SIZE, (2, 500)).astype(np.float32)
    film, view = mi.Point2f(*(upload_floats(row) for row in numbers)), upload_indices(np.zeros(500))
    tracer, found = MeshTracer(), []
    for vertices, faces in (loose(40, 1.0, 3.0), loose(300, 0.3, 0.02)):
        tracer.set_mesh(vertices, faces)
        found.append(tracer.draw(cameras, film, view, (upload_floats(vertices), upload_indices(faces))))
        expected = tracer.trace(cameras.at(view).ray(film), coherent=False)
        assert (np.array(found[-1].seen) == np.array(expected.seen)).mean() > 0.997
    assert np.array(found[0].seen).mean() > 0.5 > np.array(found[1].seen).mean()
