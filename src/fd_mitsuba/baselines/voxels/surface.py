"""The surface of a voxel grid, as a closed triangle mesh."""

from __future__ import annotations

import torch

from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.extraction.marching_tets import crossing_faces, crossing_fraction, edge_ends
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

SURFACE_ALPHA = 0.5
"""The surface is where a piece of one voxel's length covers this share of a ray."""


@torch.no_grad()
def grid_surface(grid: VoxelGrid) -> TriangleMesh | None:
    """The set of points of more than `SURFACE_ALPHA`, canonical frame, faces outwards; None where it is empty."""
    values = grid.density.detach() - grid.raw_of_alpha(SURFACE_ALPHA)
    inside = torch.zeros_like(values, dtype=torch.bool)
    inner = slice(1, -1)
    inside[inner, inner, inner] = values[inner, inner, inner] > 0  # closed within the cube
    edges, faces = crossing_faces(inside)
    if not len(faces):
        return None
    ends = torch.stack(edge_ends(edges, (grid.resolution, grid.resolution, grid.resolution)))
    lower_is_inside = inside.view(-1)[ends[0]]
    inner_end = torch.where(lower_is_inside, ends[0], ends[1])
    outer_end = torch.where(lower_is_inside, ends[1], ends[0])
    flat, places = values.reshape(-1), grid.vertices()
    fraction = crossing_fraction(flat[inner_end], flat[outer_end].clamp(max=0), 1.0)
    start = places[inner_end]
    vertices = start + fraction[:, None] * (places[outer_end] - start)
    return TriangleMesh("edited", vertices.numpy(), faces.numpy())
