"""The UV atlas: nothing is lost, nothing overlaps, nothing is mirrored; tangents against the surface's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, label

from fd_mitsuba.export.bake.atlas_raster import rasterise, weights_at
from fd_mitsuba.export.bake.tangents import vertex_tangents
from fd_mitsuba.export.bake.unwrap import padding_for, unwrap
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.vertex_normals import vertex_normals

SIZE = 256


def knot(rings: int = 120, sides: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """A closed trefoil tube, several thousand faces, far from convex."""
    t = np.linspace(0, 2 * np.pi, rings, endpoint=False)

    def curve(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1) / 4

    along = curve(t + 1e-4) - curve(t - 1e-4)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.cross(along, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    a = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = 0.15 * (np.cos(a)[:, None, None] * first + np.sin(a)[:, None, None] * second)
    vertices = (curve(t) + ring).transpose(1, 0, 2).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij"))
    corner = [((i + di) % rings) * sides + (j + dj) % sides for di, dj in ((0, 0), (0, 1), (1, 1), (1, 0))]
    faces = np.concatenate([np.stack([corner[k] for k in ks], axis=1) for ks in ((0, 2, 1), (0, 3, 2))])
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    return vertices, faces


@pytest.fixture(scope="module", params=["sphere", "knot"])
def shape(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    return unit_sphere(3) if request.param == "sphere" else knot()


def test_every_face_keeps_its_place(shape: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = shape
    mesh = unwrap(vertices, faces, SIZE)
    assert np.array_equal(mesh.vertex_map[mesh.faces], faces)
    assert np.array_equal(mesh.vertices, vertices[mesh.vertex_map])  # exact: nothing went through float32
    assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    again = unwrap(vertices, faces, SIZE)
    assert np.array_equal(mesh.uv, again.uv)


def test_charts_are_not_mirrored_and_do_not_overlap(shape: tuple[np.ndarray, np.ndarray]) -> None:
    mesh = unwrap(*shape, SIZE)
    corners = mesh.uv[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert np.all(area < 0)  # counter-clockwise with v upwards, as seen from outside
    fine = 1024
    covered = (rasterise(mesh.uv, mesh.faces, fine, 0.0).face >= 0).mean()
    assert covered == pytest.approx(-area.sum(), rel=0.01)  # less, where charts lie on each other


def test_charts_keep_their_distance(shape: tuple[np.ndarray, np.ndarray]) -> None:
    mesh = unwrap(*shape, SIZE)
    fine = 4
    covered = rasterise(mesh.uv, mesh.faces, fine * SIZE, 0.0).face >= 0
    before = label(covered, np.ones((3, 3)))[1]
    grown = binary_dilation(covered, iterations=fine * padding_for(SIZE) // 2 - 1)
    assert label(grown)[1] == before > 1


def test_rasteriser_agrees_with_a_plain_search() -> None:
    random = np.random.default_rng(0)
    corners = random.random((3, 2))
    corners = corners if np.linalg.det(corners[1:] - corners[:1]) > 0 else corners[::-1]
    raster = rasterise(corners, np.array([[0, 1, 2]]), 32, 3.0)
    y, x = np.mgrid[0:32, 0:32]
    points = np.stack([(x + 0.5) / 32, (y + 0.5) / 32], axis=-1).reshape(-1, 2)
    weights = random.dirichlet([0.4] * 3, size=20000) @ corners
    weights = np.concatenate([weights, *(np.linspace(corners[k], corners[k - 1], 500) for k in range(3))])
    away = np.sqrt(((points[:, None] - weights[None]) ** 2).sum(axis=-1)).min(axis=1).reshape(32, 32) * 32
    inside = np.all(weights_at(np.tile(corners, (len(points), 1, 1)), points)[0] >= 0, axis=1).reshape(32, 32)
    assert np.array_equal(raster.beyond[inside], np.zeros(inside.sum())) and np.all(raster.face[inside] == 0)
    sure = ~inside & (np.abs(away - 3.0) > 0.1)
    assert np.array_equal(raster.face[sure] >= 0, away[sure] < 3.0)
    near = ~inside & (raster.face >= 0)
    assert np.allclose(raster.beyond[near], away[near], atol=0.1)


def test_normals_of_a_sphere() -> None:
    vertices, faces = unit_sphere(4)
    assert np.allclose(vertex_normals(vertices, faces), vertices, atol=5e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_of_a_known_map(mirrored: bool) -> None:
    """A cylinder with u around and v down its length: the tangent is the hoop's, the bitangent the axis."""
    a, h = (x.ravel() for x in np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 1, 9), indexing="ij"))
    vertices = np.stack([np.sin(a), h, np.cos(a)], axis=1)
    uv = np.stack([a / 2, 1 - h], axis=1)
    uv[:, 0] = 1 - uv[:, 0] if mirrored else uv[:, 0]
    i, j = (x.ravel() for x in np.meshgrid(np.arange(40), np.arange(8), indexing="ij"))
    k = i * 9 + j
    faces = np.concatenate([np.stack([k, k + 9, k + 10], axis=1), np.stack([k, k + 10, k + 1], axis=1)])
    normals = np.stack([np.sin(a), 0 * a, np.cos(a)], axis=1)
    tangents = vertex_tangents(vertices, faces, normals, uv)
    hoop = np.stack([np.cos(a), 0 * a, -np.sin(a)], axis=1)
    assert np.allclose(tangents[:, :3], -hoop if mirrored else hoop, atol=1e-9)
    assert np.all(tangents[:, 3] == (-1 if mirrored else 1))
    up = tangents[:, 3:] * np.cross(normals, tangents[:, :3])
    assert np.allclose(up, [0, 1, 0], atol=1e-9)


def test_faces_without_area_lie_at_the_edge_of_a_neighbour() -> None:
    """One edge of a ball gets a vertex in its middle that only one of its sides knows, and a face without area."""
    vertices, faces = unit_sphere(2)
    (a, b, c), middle = faces[0], len(vertices)
    vertices = np.concatenate([vertices, (vertices[[a]] + vertices[[b]]) / 2])
    faces = np.concatenate([faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    mesh = unwrap(vertices, faces, SIZE)
    assert np.array_equal(mesh.vertex_map[mesh.faces], faces)
    corners = mesh.uv[mesh.faces] * SIZE
    thin, rest = corners[-1], corners[:-1].reshape(-1, 2)
    assert np.abs(thin - thin.mean(axis=0)).max() < 1.1 * np.abs(corners[0] - corners[0].mean(axis=0)).max()
    known = mesh.vertex_map[mesh.faces[:-1]].ravel()
    for vertex, place in zip(faces[-1], thin, strict=True):
        assert np.linalg.norm(rest[known == vertex] - place, axis=1).min() < 1e-6
