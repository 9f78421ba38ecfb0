"""Triangles for the analytic shapes, fine enough that a signed distance cannot tell the difference in a grid cell."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

Arrays = tuple[np.ndarray, np.ndarray]


@lru_cache(maxsize=8)
def unit_sphere(subdivisions: int = 5) -> Arrays:
    """Vertices (V, 3) on the unit sphere and outward faces (F, 3): an icosahedron split `subdivisions` times.

    F = 20 * 4^subdivisions; at 5 the faces stay within 2e-4 of the sphere. The arrays are read-only and welded.
    """
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    a, b = 1.0, golden
    vertices = np.array(
        [[-a, b, 0], [a, b, 0], [-a, -b, 0], [a, -b, 0], [0, -a, b], [0, a, b],
         [0, -a, -b], [0, a, -b], [b, 0, -a], [b, 0, a], [-b, 0, -a], [-b, 0, a]]
    )  # fmt: skip
    # The faces of the icosahedron are its hull's: three vertices at the edge length 2 from each other.
    near = np.isclose(np.linalg.norm(vertices[:, None] - vertices[None], axis=2), 2.0)
    faces = np.array(
        [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] & near[j, k] & near[i, k]]
    )
    corners = vertices[faces]
    outward = np.einsum(
        "ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners[:, 0]
    )
    faces[outward < 0] = faces[outward < 0][:, ::-1]
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    for _ in range(subdivisions):
        vertices, faces = _split(vertices, faces)
    vertices.setflags(write=False)
    faces.setflags(write=False)
    return vertices, faces


def _split(vertices: np.ndarray, faces: np.ndarray) -> Arrays:
    directed = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, edge_of = np.unique(directed, axis=0, return_inverse=True)
    middle = vertices[edges].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ca = edge_of.reshape(3, -1) + len(vertices)
    a, b, c = faces.T
    parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([vertices, middle]), np.concatenate([np.stack(part, axis=1) for part in parts])


def unit_disk(segments: int = 128) -> Arrays:
    """The disk of radius 1 in the xy plane, facing +z; it encloses nothing."""
    angle = np.arange(segments) * (2 * np.pi / segments)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(segments)], axis=1)
    index = np.arange(segments)
    faces = np.stack([index, (index + 1) % segments, np.full(segments, segments)], axis=1)
    return np.concatenate([rim, np.zeros((1, 3))]), faces


def tube(start: np.ndarray, end: np.ndarray, radius: float, segments: int = 128, rings: int = 16) -> Arrays:
    """The side of a cylinder around the axis from `start` to `end`, open at both ends, facing outwards."""
    axis = np.asarray(end, dtype=np.float64) - start
    direction = axis / np.linalg.norm(axis)
    across = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, across)
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)
    angle = np.arange(segments) * (2 * np.pi / segments)
    circle = radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    height = np.linspace(0.0, 1.0, rings + 1)
    vertices = (start + height[:, None, None] * axis + circle[None]).reshape(-1, 3)
    ring, index = np.meshgrid(np.arange(rings), np.arange(segments), indexing="ij")
    a = (ring * segments + index).ravel()
    b = (ring * segments + (index + 1) % segments).ravel()
    faces = np.concatenate([np.stack([a, b, b + segments], 1), np.stack([a, b + segments, a + segments], 1)])
    return vertices, faces
