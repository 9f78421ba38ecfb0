"""Charts of our own: discs, hardly stretched, packed without overlap; known shapes and an independent raster judge."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from test_remesh import marched, remeshed, torus

from fd_mitsuba.export.bake.atlas_raster import rasterise
from fd_mitsuba.export.bake.chart_growth import euler_numbers, grown_charts, split_chart
from fd_mitsuba.export.bake.chart_notches import charts_of
from fd_mitsuba.export.bake.chart_packing import packed_charts
from fd_mitsuba.export.bake.flatten import NotFlat, border_loops, flattened, pinched_apart
from fd_mitsuba.export.bake.unwrap import padding_for, unwrap
from fd_mitsuba.export.final_surface.mesh_rings import edges_of


def disc(rings: int = 12, around: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A fan of rings around (0, 0), radius 1, in the plane z = 0, counter-clockwise."""
    angles = 2 * np.pi * np.arange(around) / around
    points = [np.zeros((1, 2))]
    points += [(r + 1) / rings * np.stack([np.cos(angles), np.sin(angles)], axis=1) for r in range(rings)]
    index, after = np.arange(around), (np.arange(around) + 1) % around
    faces = [np.stack([np.zeros(around, int), 1 + index, 1 + after], axis=1)]
    for ring in range(rings - 1):
        a, b = 1 + ring * around, 1 + (ring + 1) * around
        faces += [np.stack([a + index, b + index, b + after], 1), np.stack([a + index, b + after, a + after], 1)]
    return np.concatenate(points), np.concatenate(faces)


def signed_areas(flat: np.ndarray, faces: np.ndarray) -> np.ndarray:
    one, other = flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]]
    return (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2


def areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def test_what_can_be_unrolled_is_unrolled() -> None:
    """A disc bent around a cylinder, of which the plane is an isometry."""
    plane, faces = disc()
    bent = np.stack([0.7 * np.sin(plane[:, 0] / 0.7), plane[:, 1], 0.7 * np.cos(plane[:, 0] / 0.7)], axis=1)
    flat = flattened(bent, faces)
    assert signed_areas(flat, faces) == pytest.approx(areas(bent, faces), rel=0.01)
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    sides = np.linalg.norm(bent[ends[:, 0]] - bent[ends[:, 1]], axis=1)
    assert np.linalg.norm(flat[ends[:, 0]] - flat[ends[:, 1]], axis=1) == pytest.approx(sides, rel=0.01)


def test_half_a_ball_keeps_its_triangles_from_folding() -> None:
    plane, faces = disc()
    radius = np.linalg.norm(plane, axis=1)
    angle = radius * np.pi / 2
    outward = plane / np.maximum(radius, 1e-9)[:, None]
    ball = np.concatenate([outward * np.sin(angle)[:, None], np.cos(angle)[:, None]], axis=1)
    flat = flattened(ball, faces)
    ratio = signed_areas(flat, faces) / areas(ball, faces)
    assert ratio.min() > 0.5 and ratio.max() < 1.6


def test_what_is_no_disc_is_not_laid_flat() -> None:
    vertices, faces = disc()
    ring = faces[24:]
    used, local = np.unique(ring, return_inverse=True)
    ring = local.reshape(-1, 3)
    assert sorted(len(loop) for loop in border_loops(ring)) == [24, 24]
    with pytest.raises(NotFlat) as bad:
        flattened(np.c_[vertices[used], np.zeros(len(used))], ring)
    assert bad.value.apart is not None
    one, other = (vertices[used][ring[face]].mean(axis=0) for face in bad.value.apart)
    assert one @ other < -0.9 * np.linalg.norm(one) * np.linalg.norm(other)  # at opposite sides of the hole
    with pytest.raises(NotFlat):
        flattened(*marched(torus, 20))


def test_what_would_overlap_names_two_faces_to_part() -> None:
    """A ring-shaped strip that goes around one and a half times, as a spiral staircase does."""
    count = 30
    turn = 3.2 * np.pi * np.arange(count) / (count - 1)
    rims = [np.stack([r * np.cos(turn), r * np.sin(turn), 0.001 * turn], axis=1) for r in (0.1, 1.0)]
    first = 2 * np.arange(count - 1)
    faces = np.concatenate([np.stack([first, first + 1, first + 2], 1), np.stack([first + 1, first + 3, first + 2], 1)])
    with pytest.raises(NotFlat) as bad:
        flattened(np.stack(rims, axis=1).reshape(-1, 3), faces)
    assert bad.value.apart is not None
    one, other = (turn[faces[face].max() // 2] for face in bad.value.apart)
    assert abs(one - other) > np.pi


def test_a_chart_that_touches_itself_at_a_vertex_is_a_disc_once_that_is_two() -> None:
    vertices, faces = disc(1, 8)
    pinched = faces[[0, 1, 4, 5]]  # two fans that meet in the middle
    assert border_loops(pinched) == []
    local, was = pinched_apart(pinched)
    assert np.array_equal(was[local], pinched) and (was == 0).sum() == 2 and len(was) == len(np.unique(pinched)) + 1
    whole, same = pinched_apart(faces)
    assert np.array_equal(same[whole], faces) and len(same) == len(vertices)


@pytest.mark.parametrize("name", ["ball", "torus", "cube"])
def test_charts_are_few_discs(name: str) -> None:
    vertices, faces = remeshed(name, 0.06)
    edges = edges_of(faces, len(vertices))
    chart = grown_charts(vertices, faces, edges)
    count = int(chart.max()) + 1
    assert 4 <= count <= 30 and np.bincount(chart).min() > 10
    assert (euler_numbers(faces, edges, chart, count) == 1).all()
    for number in range(count):
        used, local = np.unique(faces[chart == number], return_inverse=True)
        flattened(vertices[used], local.reshape(-1, 3))  # or it raises
    halves = split_chart(vertices, faces, edges, chart, 0)
    assert halves.max() == count and (halves[chart != 0] == chart[chart != 0]).all()
    assert min((halves == 0).sum(), (halves == count).sum()) > 0.2 * (chart == 0).sum()


@pytest.mark.parametrize("size", [256, 1024])
def test_the_atlas_is_full_even_and_without_overlap(size: int) -> None:
    vertices, faces = remeshed("torus", 0.05)
    mesh = unwrap(vertices, faces, size)
    flat = mesh.uv * [1, -1] * size  # v runs downwards
    texels = signed_areas(flat, mesh.faces)
    assert (texels > 0).all() and texels.sum() > 0.55 * size**2
    density = texels / areas(mesh.vertices, mesh.faces)
    assert np.percentile(density, 99) / np.percentile(density, 1) < 1.6
    chart = charts_of(mesh.faces, len(mesh.uv))
    assert len(np.unique(chart)) <= 40
    assert mesh.uv.min() > 0 and mesh.uv.max() < 1
    # Texels within half a padding of one chart are not within as much of another.
    padding, owner = padding_for(size), np.full((size, size), -1)
    for number in np.unique(chart[mesh.faces[:, 0]]):
        raster = rasterise(mesh.uv, mesh.faces[chart[mesh.faces[:, 0]] == number], size, padding / 2 - 1)
        hit = raster.face >= 0
        assert (owner[hit] == -1).all()
        owner[hit] = number


def test_a_surface_full_of_saddles_has_few_charts_all_the_same() -> None:
    """A ball whose skin waves, so that many charts have to be cut before they lie flat: small ones are joined again."""

    def waves(x: np.ndarray) -> np.ndarray:
        return 0.7 - np.linalg.norm(x, axis=-1) + 0.06 * np.sin(16 * x).sum(axis=-1)

    vertices, faces = marched(waves, 48)
    solid = igl.decimate(vertices, faces, 6000)
    mesh = unwrap(solid[0], np.asarray(solid[1], dtype=np.int64), 512)
    chart = charts_of(mesh.faces, len(mesh.uv))
    assert len(np.unique(chart)) <= 40


def test_charts_that_do_not_fit_are_left_to_others() -> None:
    flat, faces = disc()
    many = 40  # with gutters as wide as the square
    placed = np.concatenate([flat + [3 * i, 0] for i in range(many)])
    all_faces = np.concatenate([faces + i * len(flat) for i in range(many)])
    chart = np.repeat(np.arange(many), len(flat))
    assert packed_charts(placed, all_faces, chart, 64, 20) is None
    laid = packed_charts(placed, all_faces, chart, 512, 4)
    assert laid is not None and signed_areas(laid, all_faces).sum() > 0.5


def test_the_same_mesh_gives_the_same_atlas() -> None:
    vertices, faces = remeshed("torus", 0.06)
    assert np.array_equal(unwrap(vertices, faces, 256).uv, unwrap(vertices, faces, 256).uv)
