"""Whether a mesh has an inside at all."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import TriangleMesh


def encloses_volume(mesh: TriangleMesh) -> bool:
    """Whether behind at least 1 % of the area the winding number says inside: a sheet has no more than 1/2 there."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    if not length.sum() > 0:
        return False
    random = np.random.default_rng(0)
    chosen = random.choice(len(length), size=2000, p=length / length.sum())
    weights = random.dirichlet([1.0, 1.0, 1.0], size=2000)
    points = np.einsum("ij,ijk->ik", weights, corners[chosen])
    behind = 2e-3 * normal[chosen] / length[chosen, None]
    distance = MeshDistance(mesh.vertices, mesh.faces)
    number = np.maximum(
        np.abs(distance.winding_number(points - behind)), np.abs(distance.winding_number(points + behind))
    )
    return bool(np.mean(number > 0.55) >= 0.01)
