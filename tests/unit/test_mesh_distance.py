from __future__ import annotations

import numpy as np
import trimesh

from fd_mitsuba.scene.mesh_distance import MeshDistance


def test_nearest_agrees_with_trimesh(animal: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = animal
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    distance = MeshDistance(vertices, faces)
    face, weights = distance.nearest(points)
    foot = np.einsum("ij,ijk->ik", weights, vertices[faces[face]])
    # Of all faces, the nearest by trimesh's own closest points.
    found = [trimesh.triangles.closest_point(vertices[faces], np.tile(point, (len(faces), 1))) for point in points]
    gaps = [np.linalg.norm(feet - point, axis=1) for feet, point in zip(found, points, strict=True)]
    expected = np.array([feet[gap.argmin()] for feet, gap in zip(found, gaps, strict=True)])
    assert np.abs(foot - expected).max() < 1e-7
    assert np.abs(np.linalg.norm(foot - points, axis=1) - [gap.min() for gap in gaps]).max() < 1e-9


def test_nearest_on_corners_edges_and_faces_without_area() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    distance = MeshDistance(vertices, np.array([[0, 1, 2], [3, 3, 3]]))
    face, weights = distance.nearest(np.array([[-1.0, -1, 0], [0.5, -1, 0.2], [0.25, 0.25, 3], [6, 6, 6]]))
    assert face.tolist() == [0, 0, 0, 1]
    assert np.allclose(weights[:3], [[1, 0, 0], [0.5, 0.5, 0], [0.5, 0.25, 0.25]])
    assert np.all(weights >= 0) and np.allclose(weights.sum(axis=1), 1)
    assert distance.nearest(np.empty((0, 3)))[1].shape == (0, 3)
