"""How thick the walls of a part are: what a printer, or a hand, has to hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.export.solid.surface_points import surface_points
from fd_mitsuba.scene.mesh_distance import MeshDistance

_RAYS = 6000
_STEPS = 48
_START = 1e-4
"""Rays start so far below the surface, as a share of the solid's size."""
_NEAR = 1e-3
"""A ray has arrived where the surface is as near as this share of the way that it has come."""
_STANDS = 0.5
"""What is nearer to the base than this share of its thickness stands or lies on it, and is no wall of its own there."""
_FACING = -0.5
"""Cosine between the normals of the two sides of a wall: beyond 60 degrees it is an edge, which is thin by nature."""


@dataclass(frozen=True)
class Walls:
    """Measured along rays.

    Attributes:
        least: the thinnest wall that was found, in the frame's unit.
        thin: 5 % of the surface has walls that are thinner than this.
        position: (3,) on the surface, where the thinnest one is.
    """

    least: float
    thin: float
    position: np.ndarray


def measure_walls(solid: Solid, base: MeshDistance | None = None, seed: int = 0) -> Walls | None:
    """The walls of a solid, from rays straight inward at points spread evenly over its surface; None without any.

    The length of a ray counts where the side that it comes out of faces the one that it went in at, within 60 degrees.
    Exact for plates, tubes and balls; of a wedge it gives what is between its sides, not 0 at its edge. Walls smaller
    than the distance between the rays can be missed: it is a hundredth of the solid's size, about.

    Args:
        base: of the object that the solid is a part of. Rays that start or end in it, or close to it, do not count:
            what stands on the base is no wall there.
    """
    if not len(solid.faces):
        return None
    vertices = solid.vertices.astype(np.float64)
    points, face = surface_points(vertices, solid.faces, _RAYS, seed)
    a, b, c = (vertices[solid.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    if base is not None:
        outside = ~base.inside(points)
        points, face = points[outside], face[outside]
    size = float(np.ptp(vertices, axis=0).max())
    way, surface = np.full(len(points), _START * size), MeshDistance(vertices, solid.faces)
    moving = np.arange(len(points))
    for _ in range(_STEPS):  # as far as nothing is
        free = surface.unsigned(points[moving] - way[moving, None] * normals[face[moving]])
        way[moving] += free
        moving = moving[free > _NEAR * way[moving]]
        if not len(moving):
            break
    exits = points - way[:, None] * normals[face]
    opposite = normals[surface.nearest(exits)[0]]
    counts = np.einsum("ij,ij->i", normals[face], opposite) < _FACING
    counts[moving] = False
    if base is not None:
        counts &= ~base.inside(exits)
        counts &= np.minimum(base.unsigned(points), base.unsigned(exits)) > _STANDS * way
    if not counts.any():
        return None
    found = np.where(counts, way, np.inf)
    thinnest = int(found.argmin())
    return Walls(float(found[thinnest]), float(np.percentile(way[counts], 5)), points[thinnest])
