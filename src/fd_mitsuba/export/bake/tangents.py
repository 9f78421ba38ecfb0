"""The tangents that belong to a UV atlas, as game engines expect them."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.scene.vertex_normals import add_rows, angles_between, unit_vectors


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
        angle = angles_between(*(_off(edge, normal) for edge in sides))[:, None]
        add_rows(total, faces[:, corner], unit_vectors(_off(along_u, normal)) * angle)
        add_rows(handed, faces[:, corner], side[:, None] * angle)
    tangents = _off(total, normals)
    missing = np.linalg.norm(tangents, axis=1) < 1e-9
    axis = np.eye(3)[np.argmin(np.abs(normals[missing]), axis=1)]
    tangents[missing] = _off(axis, normals[missing])
    return np.concatenate([unit_vectors(tangents), np.where(handed < 0, -1.0, 1.0)], axis=1)


def face_directions(corners: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For faces with corners (F, 3, 3) and uv (F, 3, 2): the direction of growing u (F, 3), 0 where the face has no
    area in the atlas, and the sides (F,) +1 (as seen from outside), -1 (mirrored) or 0."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (u1, v1), (u2, v2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    area = u1 * v2 - u2 * v1
    side = np.where(np.abs(area) > 1e-14, -np.sign(area), 0.0)  # v runs down
    return unit_vectors((v2[:, None] * first - v1[:, None] * second) * np.sign(area)[:, None]) * np.abs(side)[
        :, None
    ], side


def _off(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return vectors - normals * np.einsum("ij,ij->i", vectors, normals)[:, None]
