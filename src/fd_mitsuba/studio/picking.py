"""Where a ray from the page meets the base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.scene.triangle_mesh import TriangleMesh


@dataclass(frozen=True)
class Hit:
    """A point (3,) of the surface, and the unit normal (3,) of its face towards the viewer."""

    point: np.ndarray
    normal: np.ndarray


def first_hit(mesh: TriangleMesh, origin: np.ndarray, direction: np.ndarray) -> Hit | None:
    """The nearest crossing of a ray and a mesh, in the mesh's frame; None where there is none.

    All faces are tested at once (Moeller and Trumbore 1997): 100k faces take some milliseconds, and a click comes once.
    """
    origin, direction = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    first, second = b - a, c - a
    across = np.cross(direction, second)
    determinant = np.einsum("ij,ij->i", first, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / determinant
        away = origin - a
        u = np.einsum("ij,ij->i", away, across) * inverse
        turned = np.cross(away, first)
        v = turned @ direction * inverse
        distance = np.einsum("ij,ij->i", second, turned) * inverse
        valid = (determinant != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not valid.any():
        return None
    index = int(np.where(valid, distance, np.inf).argmin())
    normal = np.cross(first[index], second[index])
    normal /= max(float(np.linalg.norm(normal)), 1e-30)
    if normal @ direction > 0:
        normal = -normal
    return Hit(origin + float(distance[index]) * direction, normal)
