"""Slivers put into a ball's mesh on purpose, and what is left of them."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest

from fd_mitsuba.export.final_surface.slivers import without_slivers
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles


def ball() -> tuple[np.ndarray, np.ndarray]:
    mesh = manifold3d.Manifold.sphere(1.0, 48).to_mesh()
    return np.array(mesh.vert_properties, dtype=np.float64), np.array(mesh.tri_verts, dtype=np.int64)


def with_needles_and_caps(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every eighth face with a new vertex next to a corner of it, every eighth with one next to an edge."""
    made, rows = list(vertices), []
    for number, (a, b, c) in enumerate(faces.tolist()):
        weights = {0: (0.97, 0.015, 0.015), 4: (0.495, 0.495, 0.01)}.get(number % 8)
        if weights is None:
            rows.append((a, b, c))
            continue
        fresh = len(made)
        made.append(np.array(weights) @ vertices[[a, b, c]])
        rows += [(a, b, fresh), (b, c, fresh), (c, a, fresh)]
    return np.array(made), np.array(rows)


@pytest.fixture(scope="module")
def repaired() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vertices, faces = with_needles_and_caps(*ball())
    assert (smallest_angles(vertices, faces) < 5).sum() > 400
    return without_slivers(vertices, faces, 15.0, 0.01)


def test_no_thin_triangle_is_left(repaired) -> None:
    vertices, faces, _ = repaired
    assert smallest_angles(vertices, faces).min() > 15


def test_the_surface_stays_closed_and_where_it_was(repaired) -> None:
    vertices, faces, moved = repaired
    solid = manifold3d.Manifold(manifold3d.Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))
    assert solid.status() == manifold3d.Error.NoError and solid.genus() == 0
    assert len(vertices) - len(faces) // 2 == 2
    assert solid.volume() == pytest.approx(manifold3d.Manifold.sphere(1.0, 48).volume(), rel=2e-3)
    radius = np.linalg.norm(vertices, axis=1)
    assert radius.max() < 1 + 1e-6 and radius.min() > 0.98
    known = np.concatenate([with_needles_and_caps(*ball())[0]])
    away = np.array([np.linalg.norm(known - vertex, axis=1).min() for vertex in vertices])
    assert (away[~moved] < 1e-9).all()


def test_a_good_mesh_is_left_alone() -> None:
    vertices, faces = ball()
    after, rows, moved = without_slivers(vertices, faces, 10.0, 0.01)
    assert np.array_equal(after, vertices) and np.array_equal(rows, faces) and not moved.any()


def test_a_surface_is_not_moved_farther_than_allowed() -> None:
    """A spike on a ball is slender all over; it may not go."""
    vertices, faces = ball()
    spike = vertices.copy()
    spike[100] *= 1.5
    after, rows, _ = without_slivers(spike, faces, 25.0, 0.01)
    assert np.linalg.norm(after, axis=1).max() > 1.48 and len(rows) > 0
