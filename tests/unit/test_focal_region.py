from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fd_mitsuba.scene.focal_region import FocalRegion, union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import tube, unit_disk, unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology


def affine(
    scale: tuple[float, ...], turn: tuple[float, ...] = (0, 0, 0), move: tuple[float, ...] = (0, 0, 0)
) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix() @ np.diag(scale)
    matrix[:3, 3] = move
    return matrix


def test_sphere_is_exact() -> None:
    region = FocalRegion("ball", affine((0.4, 0.4, 0.4), (10, 20, 30), (0.1, 0.2, 0.3)))
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    expected = 0.4 - np.linalg.norm(points - [0.1, 0.2, 0.3], axis=1)
    assert np.abs(region.sdf(points) - expected).max() < 1e-6
    assert region.sdf(points).dtype == np.float32


@pytest.mark.parametrize("scale", [(0.2, 0.45, 0.12), (0.5, 0.05, 0.5), (0.9, 0.1, 0.1), (0.3, -0.2, 0.1)])
def test_ellipsoid_distance_matches_that_of_its_fine_mesh(scale: tuple[float, ...]) -> None:
    region = FocalRegion("wing", affine(scale, (-15, 40, 5), (-0.3, 0.4, -0.1)))
    random = np.random.default_rng(1)
    points = random.uniform(-1, 1, (500, 3))
    surface = region.surface(6)
    nearest = MeshDistance(surface.vertices, surface.faces).unsigned(points)
    local = (points - region.to_canonical[:3, 3]) @ np.linalg.inv(region.to_canonical[:3, :3]).T
    expected = np.where(np.linalg.norm(local, axis=1) < 1, nearest, -nearest)
    assert np.abs(region.sdf(points) - expected).max() < 3e-4


@settings(deadline=None, max_examples=50)
@given(
    scale=st.tuples(*[st.floats(0.02, 1.0)] * 3),
    turn=st.tuples(*[st.floats(-180, 180)] * 3),
    seed=st.integers(0, 1000),
)
def test_moving_along_the_normal_changes_the_distance_by_as_much(
    scale: tuple[float, ...], turn: tuple[float, ...], seed: int
) -> None:
    matrix = affine(scale, turn, (0.1, -0.2, 0.3))
    region = FocalRegion("r", matrix)
    unit = np.random.default_rng(seed).normal(size=(64, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normal = unit @ np.linalg.inv(matrix[:3, :3])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    surface = unit @ matrix[:3, :3].T + matrix[:3, 3]
    for step in (0.0, 0.05, 0.5, 3.0):
        assert np.abs(region.sdf(surface + step * normal) + step).max() < 1e-5


def test_points_on_the_axes_and_at_the_centre_are_finite() -> None:
    region = FocalRegion("r", affine((0.5, 0.3, 0.1)))
    points = np.array([[0, 0, 0], [0.45, 0, 0], [0, 0.2, 0], [0, 0, 0.1], [0, 0, 5], [1, 0, 0]], dtype=float)
    assert np.allclose(region.sdf(points), [0.1, _deep(0.45), _deep_y(0.2), 0, -4.9, -0.5], atol=1e-4)


def _deep(x: float) -> float:
    """Distance from (x, 0, 0) inside the ellipsoid (.5, .3, .1) to its surface, by brute force in the xz plane."""
    angle = np.linspace(0, np.pi / 2, 200001)
    return float(np.min(np.hypot(0.5 * np.cos(angle) - x, 0.1 * np.sin(angle))))


def _deep_y(y: float) -> float:
    angle = np.linspace(0, np.pi / 2, 200001)
    return float(np.min(np.hypot(0.3 * np.cos(angle) - y, 0.1 * np.sin(angle))))


def test_bounds_volume_and_thickness() -> None:
    region = FocalRegion("r", affine((0.2, 0.45, 0.12), (30, -50, 70), (0.3, 0.1, 0.2)))
    low, high = region.bounds
    surface = region.surface(6).vertices
    assert np.allclose(surface.min(axis=0), low, atol=1e-3) and np.allclose(surface.max(axis=0), high, atol=1e-3)
    assert np.isclose(region.volume, 4 / 3 * np.pi * 0.2 * 0.45 * 0.12)
    assert np.isclose(region.thickness, 0.24)
    assert np.isclose(region.surface(5).volume(), region.volume, rtol=2e-3)


def test_mirrored_region_has_an_outward_surface() -> None:
    assert FocalRegion("r", affine((-0.2, 0.3, 0.4))).surface().volume() > 0


def test_mesh_region_agrees_with_the_ellipsoid_of_the_same_shape() -> None:
    matrix = affine((0.3, 0.4, 0.2), (0, 30, 0), (0.1, 0.1, 0.1))
    ellipsoid = FocalRegion("e", matrix)
    mesh = FocalRegion("m", matrix, mesh=ellipsoid.surface(5))
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    assert np.abs(mesh.sdf(points) - ellipsoid.sdf(points)).max() < 2e-3
    assert np.isclose(mesh.volume, ellipsoid.volume, rtol=5e-3)
    assert np.isclose(mesh.thickness, ellipsoid.thickness, rtol=0.1)
    assert not mesh.is_ellipsoid and ellipsoid.is_ellipsoid


def test_union_is_the_largest() -> None:
    left, right = (FocalRegion(n, affine((0.2, 0.2, 0.2), move=(x, 0, 0))) for n, x in (("l", -0.3), ("r", 0.3)))
    points = np.array([[-0.3, 0, 0], [0.3, 0, 0], [0, 0, 0]], dtype=float)
    assert np.allclose(union_sdf((left, right), points), [0.2, 0.2, -0.1], atol=1e-6)


def test_a_matrix_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        FocalRegion("r", np.full((4, 4), np.nan))


def test_tessellations_are_closed_or_open_as_they_should_be() -> None:
    sphere = topology(*unit_sphere(3))
    assert sphere.closed and sphere.components == 1 and sphere.misoriented_edges == 0
    assert TriangleMesh("s", *unit_sphere(5)).volume() == pytest.approx(4 / 3 * np.pi, rel=1e-3)
    side = topology(*tube(np.zeros(3), np.array([0.0, 2.0, 0.0]), 0.5))
    assert not side.closed and side.boundary_edges == 256 and side.misoriented_edges == 0
    assert topology(*unit_disk()).boundary_edges == 128


def test_tube_faces_outwards() -> None:
    vertices, faces = tube(np.zeros(3), np.array([1.0, 2.0, 0.5]), 0.5)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.array([1.0, 2.0, 0.5]) / np.linalg.norm([1.0, 2.0, 0.5])
    middle = corners.mean(axis=1)
    outwards = middle - (middle @ axis)[:, None] * axis
    assert np.all(np.einsum("ij,ij->i", normal, outwards) > 0)
