"""Where a focal region lies: how much of it the grid holds, and how far it is from the base."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.focal_region import SUBTRACT, FocalRegion
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

LEAST_SHARE_IN_GRID = 0.5
"""A region with less of its volume than this in the grid cube is an error; a smaller overhang is a warning."""


def misplacement(region: FocalRegion, gap: float, frame: Normalisation) -> str | None:
    """What is wrong with where a region lies, if anything; `gap` is that to the base."""
    inside = share_in_grid(region)
    if inside < LEAST_SHARE_IN_GRID:
        low, high = frame.to_user(np.full(3, -GRID_HALF_EXTENT)), frame.to_user(np.full(3, GRID_HALF_EXTENT))
        box = f"{_short(low)} to {_short(high)}"
        return f"{inside:.0%} of the region lies in the editable cube {box}; move or shrink it"
    if region.mode == SUBTRACT and gap > 0:
        return "does not reach the base, so nothing can be cut out; move it into the base"
    if gap > region.size:
        return f"the region is {gap / frame.scale:.3g} away from the base, more than its own size; move it closer"
    return None


def refuse_hidden_parts(path: Path, regions: tuple[FocalRegion, ...], base: TriangleMesh) -> None:
    """UserError if all regions of a part that is to be added lie wholly within the base, where nothing is ever seen.

    Args:
        path: the scene, for the message.
        base: in the canonical frame.
    """
    distance = MeshDistance(base.vertices, base.faces)
    for part in dict.fromkeys(region.part for region in regions):
        own = [region for region in regions if region.part == part]
        if all(region.mode != SUBTRACT and distance.inside(region.surface(3).vertices).all() for region in own):
            where = "lies wholly within the base, where nothing of the part is ever seen; move it outwards"
            raise UserError(f"{path}: region {own[0].name}: {where}")


def share_in_grid(region: FocalRegion, samples: int = 24) -> float:
    """Share of the region's volume within the grid cube [-1.05, 1.05]^3, sampled on a lattice over its bounds."""
    low, high = region.bounds
    steps = (np.arange(samples) + 0.5) / samples
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = low + lattice * (high - low)
    points = points[region.sdf(points) > 0]
    if not len(points):
        points = region.surface(2).vertices
    return float(np.mean(np.all(np.abs(points) <= GRID_HALF_EXTENT, axis=1)))


def gap_to_base(region: FocalRegion, distance: MeshDistance, base: TriangleMesh) -> float:
    """Distance between the region and the base in canonical units; 0 where they overlap or one contains the other.

    Args:
        distance: of the base in the canonical frame.
        base: the same base in the canonical frame; its vertices are tested against the region too.
    """
    surface = region.surface_points()
    if distance.inside(surface).any():
        return 0.0
    to_surface = float(distance.unsigned(surface).min())
    to_vertices = float(-region.sdf(base.vertices).max())
    return max(min(to_surface, to_vertices), 0.0)


def _short(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in point) + ")"
