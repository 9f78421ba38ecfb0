"""A voxel grid as the outcome of an edit."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

from fd_mitsuba.baselines.interface import EditedImages, EditedObject
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.rendering import grid_images
from fd_mitsuba.baselines.voxels.surface import grid_surface
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch

IMAGE_SAMPLES = 128
"""Pieces of a ray in the images that methods are compared by."""


class EditedVoxels(EditedObject):
    """An edit whose outcome is a voxel grid: images are volume renderings.

    Args:
        base: images of the unedited base that are like the grid's; None: its normals.
    """

    def __init__(
        self,
        scene: EditScene,
        grid: VoxelGrid,
        fit: dict[str, float],
        base: Callable[[CameraBatch, int], EditedImages] | None = None,
    ) -> None:
        super().__init__(scene, fit)
        self.grid, self._base = grid, base

    def images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """Expected normals or colours, and coverage."""
        return grid_images(self.grid, cameras, size, IMAGE_SAMPLES)

    def base_images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """Of the base's own mesh, not of the grid that was fitted to it."""
        return super().base_images(cameras, size) if self._base is None else self._base(cameras, size)

    @cached_property
    def _mesh(self) -> TriangleMesh | None:
        return grid_surface(self.grid)

    @property
    def mesh(self) -> TriangleMesh | None:
        """A level of the density; see `surface.grid_surface`."""
        return self._mesh
