from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from fd_mitsuba.fields import base_shape
from fd_mitsuba.fields.base_shape import base_sdf
from fd_mitsuba.scene.tessellate import unit_sphere


def grid(cells: int, half: float = 1.05) -> np.ndarray:
    axis = np.linspace(-half, half, cells + 1)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def test_sphere_is_analytic(tmp_path: Path) -> None:
    vertices, faces = unit_sphere(5)
    points = grid(24)
    sdf = base_sdf(points, 0.7 * vertices, faces, tmp_path)
    assert sdf.dtype == np.float32 and sdf.shape == (len(points),)
    assert np.abs(sdf - (0.7 - np.linalg.norm(points, axis=1))).max() < 5e-4


def test_matches_trimesh_on_an_animal(tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = animal
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    triangles = mesh.triangles
    distance = np.array(
        [
            np.linalg.norm(
                trimesh.triangles.closest_point(triangles, np.tile(p, (len(triangles), 1))) - p, axis=1
            ).min()
            for p in points
        ]
    )
    solid_angle = _winding(triangles, points)
    expected = np.where(solid_angle > 0.5, distance, -distance)
    assert np.abs(base_sdf(points, vertices, faces, tmp_path) - expected).max() < 1e-6


def _winding(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Winding number by the sum of solid angles (van Oosterom and Strackee), no approximation."""
    a, b, c = (triangles[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    top = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    dot = lambda x, y: np.einsum("ijk,ijk->ij", x, y)  # noqa: E731
    bottom = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.arctan2(top, bottom).sum(axis=1) / (2 * np.pi)


def test_many_points_are_exact_near_the_surface_and_bounded_elsewhere(
    tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]
) -> None:
    vertices, faces = animal
    points = grid(44)  # 91k points: the coarse lattice is used
    assert len(points) > base_shape._EXACT_BELOW
    fast = base_sdf(points, vertices, faces, tmp_path)
    chosen = np.random.default_rng(0).choice(len(points), 8000, replace=False)
    exact = base_sdf(points[chosen], vertices, faces, tmp_path)
    error = np.abs(fast[chosen] - exact)
    assert np.array_equal(fast[chosen] > 0, exact > 0)
    assert error[np.abs(exact) < base_shape.EXACT_SHARE * 2.1].max() == 0
    assert error.max() < 0.03
    assert np.median(error) < 1e-3


def test_open_mesh_keeps_its_inside(tmp_path: Path) -> None:
    vertices, faces = unit_sphere(4)
    kept = faces[vertices[faces].mean(axis=1)[:, 1] < 0.8]  # a lid is missing
    points = np.array([[0, 0, 0], [0, -0.9, 0], [0.7, 0, 0], [0, 1.5, 0], [0, -1.2, 0], [1.3, 0, 0]], dtype=float)
    sdf = base_sdf(points, vertices, kept, tmp_path)
    assert np.array_equal(sdf > 0, [True, True, True, False, False, False])
    assert np.allclose(np.abs(sdf[[1, 2, 4, 5]]), [0.1, 0.3, 0.2, 0.3], atol=5e-3)


def test_overlapping_components_and_duplicate_vertices(tmp_path: Path) -> None:
    vertices, faces = unit_sphere(4)
    soup = np.concatenate([vertices[faces].reshape(-1, 3) - [0.5, 0, 0], vertices[faces].reshape(-1, 3) + [0.5, 0, 0]])
    triangles = np.arange(len(soup)).reshape(-1, 3)
    points = np.array([[0, 0, 0], [-1.2, 0, 0], [1.2, 0, 0], [0, 1.2, 0]], dtype=float)
    assert np.array_equal(base_sdf(points, soup, triangles, tmp_path) > 0, [True, True, True, False])


def test_inside_out_mesh_is_still_solid(tmp_path: Path) -> None:
    vertices, faces = unit_sphere(4)
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    straight, turned = (base_sdf(points, vertices, f, tmp_path) for f in (faces, faces[:, ::-1]))
    assert np.allclose(straight, turned, atol=1e-6)


def test_cache_is_used_and_follows_the_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = unit_sphere(2)
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    first = base_sdf(points, vertices, faces, tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    with monkeypatch.context() as patch:
        patch.setattr(base_shape, "MeshDistance", None)  # would fail if it were computed again
        assert np.array_equal(base_sdf(points, vertices, faces, tmp_path), first)
    moved = base_sdf(points, vertices * 1.01, faces, tmp_path)
    assert not np.array_equal(moved, first) and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "garbage"])
def test_damaged_cache_is_computed_anew(tmp_path: Path, damage: str) -> None:
    vertices, faces = unit_sphere(2)
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    expected = base_sdf(points, vertices, faces, tmp_path)
    (entry,) = tmp_path.iterdir()
    data = bytearray(entry.read_bytes())
    flipped = bytearray(data)
    flipped[100] ^= 1
    entry.write_bytes({"truncate": data[:-7], "flip": flipped, "empty": b"", "garbage": b"x" * len(data)}[damage])
    assert np.array_equal(base_sdf(points, vertices, faces, tmp_path), expected)
    assert entry.read_bytes() == bytes(data)


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    vertices, faces = unit_sphere(2)
    assert base_sdf(np.zeros((1, 3)), vertices, faces, blocker / "cache")[0] > 0.9


def test_default_cache_follows_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    vertices, faces = unit_sphere(1)
    base_sdf(np.zeros((1, 3)), vertices, faces)
    assert len(list((tmp_path / "fd_mitsuba").glob("*.sdf"))) == 1
