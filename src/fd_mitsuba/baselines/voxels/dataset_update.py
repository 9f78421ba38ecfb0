"""Iterative dataset update: images are edited one after the other, while a voxel grid is fitted to all of them.

Instruct-NeRF2NeRF (arXiv 2303.12789). One step here is one update:

1. a view of the set is rendered from the present grid;
2. an editor of single images makes another image of it, from the render with noise, beside the unedited base;
3. this image takes the view's place in the set;
4. the grid is fitted on, to rays of all images of the set.

Views that were edited apart from each other agree on nothing; the grid is what brings them together.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from fd_mitsuba.baselines.image_editors.views import Beginning, resized
from fd_mitsuba.baselines.interface import EditedImages
from fd_mitsuba.baselines.voxels.fitting import ViewRays
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.rendering import grid_images
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import RunStopped
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.training.weight_average import WeightAverage
from fd_mitsuba.viewing.sheets import as_bytes, stacked

EditView = Callable[[CameraBatch, Beginning], EditedImages]
"""An editor of one view; `EditedViews.edit` is one."""


class ImageSet(nn.Module):
    """A grid and the images that it is fitted to: what a checkpoint holds.

    Args:
        grid: stays as it is; a copy of it is fitted.
        rays: through all pixels of the unedited images.
    """

    def __init__(self, grid: VoxelGrid, rays: ViewRays) -> None:
        super().__init__()
        self.grid = VoxelGrid(grid.resolution, len(grid.features), grid.half_extent, grid.kind, grid.background)
        self.grid.load_state_dict(grid.state_dict())
        self.seen: Tensor
        self.register_buffer("seen", rays.seen)


class DatasetUpdateStage:
    """A stage whose field is an `ImageSet`; see `training.stage.Stage`.

    Args:
        config: the run's settings: seed, output.
        edit: makes the edited image of a view.
        base: the fitted grid.
        images: of the unedited base from `cameras`, one for each; the set, before any edit.
        side: pixels a side of what the editor is given.
        updates: steps.
        fit_steps: steps of the fit after each update. rays: of each of these. samples: pieces of a ray.
        learning_rate: of the fit.
        noise_range: shares of all timesteps between which the noise upon the renders is drawn.
    """

    name = "geometry"
    average: WeightAverage | None = None

    def __init__(
        self,
        config: RunConfig,
        edit: EditView,
        base: VoxelGrid,
        images: EditedImages,
        cameras: CameraBatch,
        side: int,
        updates: int,
        fit_steps: int,
        rays: int,
        samples: int,
        learning_rate: float,
        noise_range: tuple[float, float],
    ) -> None:
        self.config, self.steps = config, updates
        self._edit, self._cameras, self._side, self._size = edit, cameras, side, images.mask.shape[-1]
        self._fit_steps, self._count, self._samples, self._noise = fit_steps, rays, samples, noise_range
        self._rays = ViewRays(images, cameras, base.half_extent)
        self.field = ImageSet(base, self._rays)
        self.optimiser = torch.optim.Adam(self.field.grid.parameters(), lr=learning_rate, eps=1e-15)
        self.counters: dict[str, int] = {}

    def phase_name(self, step: int) -> str:
        """There is one."""
        return "updates"

    def view_of(self, step: int) -> int:
        """The view that a step edits: all of them in a random order, and then in another one."""
        count = len(self._cameras)
        order = np.random.default_rng(seed_for(self.config.seed, Purpose.VIEWS, step // count)).permutation(count)
        return int(order[step % count])

    def step(self, step: int) -> StepRecord:
        """Edit one view and fit on; RunStopped if a number is not finite."""
        view, grid = self.view_of(step), self.field.grid
        camera = self._cameras.some(slice(view, view + 1))
        draw = np.random.default_rng(seed_for(self.config.seed, Purpose.SAMPLES, step))
        level = float(draw.uniform(*self._noise))
        render = grid_images(grid, camera, self._side, self._samples)
        edited = self._edit(camera, Beginning(render, level, step))
        self._rays.replace(view, resized(edited, self._size))
        generator = torch.Generator().manual_seed(seed_for(self.config.seed, Purpose.PIXELS, step))
        values = []
        for _ in range(self._fit_steps):
            loss = self._rays.loss(grid, self._count, self._samples, generator)
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
            values.append(float(loss.detach()))
        if not np.isfinite(values[-1]):
            raise RunStopped(f"step {step}: the voxel grid is not finite; lower the method's learning_rate")
        change = float((edited.rgb - render.rgb).abs().mean())
        found = {"loss": values[-1], "image_change": change, "noise_level": level}
        return StepRecord(found, partial(_sheet, render, edited))

    def check_field(self, step: int) -> dict[str, float]:
        """The share of voxels that are solid; RunStopped where none is."""
        solid = float((self.field.grid.density > 0).float().mean())
        if solid == 0:
            raise RunStopped(f"step {step}: the voxel grid is empty; lower the method's learning_rate")
        return {"solid_share": solid}


def _sheet(render: EditedImages, edited: EditedImages) -> np.ndarray:
    """The view before and after its edit."""
    return stacked([np.concatenate(list(as_bytes(torch.cat([render.rgb, edited.rgb]))), axis=1)])
