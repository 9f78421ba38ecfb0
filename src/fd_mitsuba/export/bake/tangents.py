"""Smooth normals and the tangents that belong to a UV atlas, as game engines expect them."""

from __future__ import annotations

import numpy as np


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) float64: mean of the faces' normals, weighted by their angle at the vertex.

    A vertex without a face that has area gets +y.
    """
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = _unit(flat)
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        angle = _angle(corners[:, (corner + 1) % 3] - corners[:, corner], corners[:, corner - 1] - corners[:, corner])
        _add(total, faces[:, corner], flat * angle[:, None])
    missing = np.linalg.norm(total, axis=1) < 1e-12
    total[missing] = (0.0, 1.0, 0.0)
    return _unit(total)


def vertex_tangents(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Tangents (V, 4) float64 as in glTF: unit and orthogonal to the normal, w = -1 where the atlas is mirrored.

    The direction is that of growing u; the bitangent is w * cross(normal, tangent) and runs up in the picture, against
    v. As MikkTSpace does it, each face's direction is projected to the vertex's tangent plane, made unit and weighted
    by the face's angle there; the vertices must be split already where the atlas is. A vertex whose faces have no area
    in the atlas gets any direction.

    Args:
        uv: (V, 2), origin top left and v downwards.
    """
    normals = np.asarray(normals, dtype=np.float64)
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    along_u, side = face_directions(corners, np.asarray(uv, dtype=np.float64)[faces])
    total, handed = np.zeros((len(vertices), 3)), np.zeros((len(vertices), 1))
    for corner in range(3):
        normal = normals[faces[:, corner]]
        sides = [corners[:, (corner + step) % 3] - corners[:, corner] for step in (1, 2)]
        angle = _angle(*(_off(edge, normal) for edge in sides))[:, None]
        _add(total, faces[:, corner], _unit(_off(along_u, normal)) * angle)
        _add(handed, faces[:, corner], side[:, None] * angle)
    tangents = _off(total, normals)
    missing = np.linalg.norm(tangents, axis=1) < 1e-9
    axis = np.eye(3)[np.argmin(np.abs(normals[missing]), axis=1)]
    tangents[missing] = _off(axis, normals[missing])
    return np.concatenate([_unit(tangents), np.where(handed < 0, -1.0, 1.0)], axis=1)


def face_directions(corners: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For faces with corners (F, 3, 3) and uv (F, 3, 2): the direction of growing u (F, 3), 0 where the face has no
    area in the atlas, and the sides (F,) +1 (as seen from outside), -1 (mirrored) or 0."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (u1, v1), (u2, v2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    area = u1 * v2 - u2 * v1
    side = np.where(np.abs(area) > 1e-14, -np.sign(area), 0.0)  # v runs down
    return _unit((v2[:, None] * first - v1[:, None] * second) * np.sign(area)[:, None]) * np.abs(side)[:, None], side


def _off(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return vectors - normals * np.einsum("ij,ij->i", vectors, normals)[:, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-30, vectors / np.maximum(length, 1e-30), 0.0)


def _angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ij,ij->i", first, second))


def _add(target: np.ndarray, rows: np.ndarray, values: np.ndarray) -> None:
    for column in range(target.shape[1]):
        target[:, column] += np.bincount(rows, weights=values[:, column], minlength=len(target))
