"""Normals of meshes that stay as they are, against Mitsuba's own, trimesh's, and a cube cut in two ways."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from fd_mitsuba.scene.vertex_normals import vertex_normals


def cube() -> tuple[np.ndarray, np.ndarray]:
    """Every side is cut along a diagonal, so that some of its corners have two triangles of it."""
    box = trimesh.creation.box()
    return np.asarray(box.vertices), np.asarray(box.faces)


def test_by_angle_the_diagonals_of_a_cube_do_not_show() -> None:
    vertices, faces = cube()
    expected = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, faces), expected, atol=1e-12)
    assert np.abs(vertex_normals(vertices, faces, weights="area") - expected).max() > 0.1


def test_by_angle_they_are_those_of_mitsuba(mi: Any, animal: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = animal
    mesh = mi.Mesh("animal", len(vertices), len(faces), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    mesh.recompute_vertex_normals()
    theirs = np.array(mi.traverse(mesh)["vertex_normals"]).reshape(-1, 3)
    np.testing.assert_allclose(vertex_normals(vertices.astype(np.float32), faces), theirs, atol=2e-4)


def test_by_area_they_are_the_normal_of_what_is_around() -> None:
    # The area vectors around a vertex add up to three times the derivative of the volume by its position.
    vertices, faces = cube()
    vertices = vertices + 0.1 * np.random.default_rng(0).normal(size=vertices.shape)
    volume = [
        [trimesh.Trimesh(vertices + step * (np.arange(8) == vertex)[:, None] * axis, faces).volume for step in (-1, 1)]
        for vertex in range(8)
        for axis in np.eye(3)
    ]
    slope = np.diff(volume, axis=1).reshape(8, 3)
    expected = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, faces, weights="area"), expected, atol=1e-6)


@pytest.mark.parametrize("weights", ["angle", "area"])
def test_the_two_sides_of_a_seam_agree_where_they_are_welded(weights: Any) -> None:
    vertices, faces = cube()
    apart = vertices[faces].reshape(-1, 3)
    loose = np.arange(len(apart)).reshape(-1, 3)
    welded = vertex_normals(apart, loose, weights, welded=True)
    np.testing.assert_allclose(welded, vertex_normals(vertices, faces, weights)[faces.ravel()], atol=1e-12)
    flat = vertex_normals(apart, loose, weights)
    assert np.abs(flat).max(axis=1) == pytest.approx(1) and np.abs(flat - welded).max() > 0.1


@pytest.mark.parametrize("weights", ["angle", "area"])
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_the_size_does_not_matter(weights: Any, size: float) -> None:
    vertices, faces = cube()
    np.testing.assert_allclose(
        vertex_normals(size * vertices, faces, weights), vertex_normals(vertices, faces, weights), atol=1e-9
    )


def test_where_nothing_has_an_area_it_is_up() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 1], [9, 9, 9]])
    both_ways = np.array([[0, 1, 3], [0, 3, 1]])
    for weights in ("angle", "area"):
        found = vertex_normals(vertices, np.array([[0, 1, 2]]), weights)
        assert (found == [0, 1, 0]).all()
        assert (vertex_normals(vertices, both_ways, weights) == [0, 1, 0]).all()
    assert vertex_normals(np.zeros((0, 3)), np.zeros((0, 3), int)).shape == (0, 3)
