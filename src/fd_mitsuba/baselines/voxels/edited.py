"""A voxel grid as the outcome of an edit."""

from __future__ import annotations

from functools import cached_property

import torch

from fd_mitsuba.baselines.interface import EditedImages, EditedObject
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.rendering import render_normals
from fd_mitsuba.baselines.voxels.surface import grid_surface
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch

IMAGE_SAMPLES = 128
"""Pieces of a ray in the images that methods are compared by."""


class EditedVoxels(EditedObject):
    """An edit whose outcome is a voxel grid: images are volume renderings."""

    def __init__(self, scene: EditScene, grid: VoxelGrid, fit: dict[str, float]) -> None:
        super().__init__(scene, fit)
        self.grid = grid

    @torch.no_grad()
    def images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """Expected normals and coverage."""
        return EditedImages("normals", *render_normals(self.grid, cameras, size, IMAGE_SAMPLES))

    @cached_property
    def _mesh(self) -> TriangleMesh | None:
        return grid_surface(self.grid)

    @property
    def mesh(self) -> TriangleMesh | None:
        """A level of the density; see `surface.grid_surface`."""
        return self._mesh
