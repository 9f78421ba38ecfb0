"""Remeshing against closed forms, with scikit-image's marching cubes for input, and trimesh and libigl for judges."""

from __future__ import annotations

from collections.abc import Callable

import igl
import numpy as np
import pytest
import trimesh
from skimage.measure import marching_cubes

from fd_mitsuba.export.final_surface.projection import project
from fd_mitsuba.export.final_surface.remesh import remesh
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import unit_sphere

Function = Callable[[np.ndarray], np.ndarray]
EDGE = 0.04


def ball(x: np.ndarray) -> np.ndarray:
    return 0.7 - np.linalg.norm(x, axis=-1)


def torus(x: np.ndarray) -> np.ndarray:
    return 0.2 - np.hypot(np.hypot(x[..., 0], x[..., 1]) - 0.6, x[..., 2])


def cube(x: np.ndarray) -> np.ndarray:
    return 0.6 - np.abs(x).max(axis=-1)


def two_balls(x: np.ndarray) -> np.ndarray:
    """With a concave edge between them."""
    return 0.4 - np.minimum(np.linalg.norm(x - [0.25, 0, 0], axis=-1), np.linalg.norm(x + [0.25, 0, 0], axis=-1))


SHAPES = {"ball": ball, "torus": torus, "cube": cube, "two_balls": two_balls}


def marched(function: Function, cells: int = 50) -> tuple[np.ndarray, np.ndarray]:
    axis = np.linspace(-1, 1, cells + 1)
    values = function(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1))
    vertices, faces, _, _ = marching_cubes(-values, 0, spacing=(2 / cells,) * 3)
    return vertices.astype(float) - 1, faces.astype(np.int64)


def with_gradient(function: Function) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    step = 1e-6 * np.eye(3)

    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = [(function(x + step[i]) - function(x - step[i])) / 2e-6 for i in range(3)]
        return function(x), np.stack(slope, axis=-1)

    return both


def remeshed(name: str, edge: float = EDGE) -> tuple[np.ndarray, np.ndarray]:
    both = with_gradient(SHAPES[name])
    vertices, faces = remesh(*marched(SHAPES[name]), edge, lambda x: project(both, x, 0.02, 2, 1e-6)[:2])
    return project(both, vertices, 0.02, 12, 1e-9)[0], faces


@pytest.mark.parametrize("name", SHAPES)
def test_triangles_are_even_and_the_surface_is_the_shapes(name: str) -> None:
    vertices, faces = remeshed(name)
    before, after = smallest_angles(*marched(SHAPES[name])), smallest_angles(vertices, faces)
    assert np.percentile(before, 5) < 20 or name == "cube"
    assert np.percentile(after, 5) > 38 and after.min() > 10
    assert np.abs(SHAPES[name](vertices)).max() < 1e-3 * EDGE
    ends = vertices[faces]
    lengths = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2)
    assert lengths.mean() == pytest.approx(EDGE, rel=0.1)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("edge", [0.02, 0.1])
def test_it_stays_a_solid_of_the_same_kind(name: str, edge: float) -> None:
    vertices, faces = remeshed(name, edge)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert igl.is_edge_manifold(faces)[0] and np.all(igl.is_vertex_manifold(faces))
    assert mesh.euler_number == (0 if name == "torus" else 2)
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)


def test_volume_is_the_closed_forms() -> None:
    for name, volume in {"ball": 4 / 3 * np.pi * 0.7**3, "torus": 2 * np.pi**2 * 0.6 * 0.2**2, "cube": 1.2**3}.items():
        mesh = trimesh.Trimesh(*remeshed(name, 0.03), process=False)
        assert mesh.volume == pytest.approx(volume, rel=0.005), name


def test_an_edge_of_a_cube_is_cut_off_by_less_than_an_edge_of_its_triangles() -> None:
    vertices, faces = remeshed("cube")
    along = np.linspace(-0.5, 0.5, 200)
    edge = np.stack([np.full(200, 0.6), np.full(200, 0.6), along], axis=1)
    assert MeshDistance(vertices, faces).unsigned(edge).max() < 0.6 * EDGE


def test_the_same_input_gives_the_same_mesh() -> None:
    for one, other in zip(remeshed("two_balls"), remeshed("two_balls"), strict=True):
        assert np.array_equal(one, other)


def test_a_tetrahedron_and_other_small_solids_survive() -> None:
    vertices = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    for edge in (0.5, 10.0):  # finer, and coarser than it is
        made, triangles = remesh(vertices, faces, edge, lambda x: (x, x))
        mesh = trimesh.Trimesh(made, triangles, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == 2
        assert (len(triangles) == 4) == (edge == 10.0)


def test_folds_that_come_in_are_gone() -> None:
    """A decimated mesh has some: a corner pushed across the opposite side turns a triangle over."""
    vertices, faces = unit_sphere(3)
    vertices, folded = vertices.astype(np.float64), faces[::97]
    for a, b, c in folded:
        vertices[a] += 1.3 * ((vertices[b] + vertices[c]) / 2 - vertices[a])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)

    def outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        corners = vertices[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.einsum("ij,ij->i", cross, corners.mean(axis=1))

    def onto(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = points / np.linalg.norm(points, axis=1, keepdims=True)
        return points, points

    assert (outward(vertices, faces) < 0).sum() >= len(folded), "the premise"
    made, triangles = remesh(vertices, faces, 0.12, onto, 4)
    assert (outward(made, triangles) > 0).all() and len(triangles) > 0.8 * len(faces)


def test_an_open_mesh_is_refused() -> None:
    vertices, faces = marched(ball, 10)
    with pytest.raises(ValueError, match="has not two faces"):
        remesh(vertices, faces[1:], 0.1, lambda x: (x, x))
