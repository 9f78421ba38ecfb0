"""Objects that exist only as edited views: each image is edited on its own when it is asked for."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from fd_mitsuba.baselines.interface import EditedImages, EditedObject, EditTask
from fd_mitsuba.render.region_views import RegionViews
from fd_mitsuba.scene.views import CameraBatch


@dataclass(frozen=True)
class Beginning:
    """What sampling begins from, where that is not noise alone.

    Attributes:
        images: N views at the editor's size.
        level: of the noise upon them, as a share of all timesteps in (0, 1).
        draw: another number, another noise.
    """

    images: EditedImages
    level: float
    draw: int = 0


class EditedViews(EditedObject):
    """No object behind its images: what one view shows, another need not."""

    side: int
    """Pixels a side of the model's own size."""

    def __init__(self, task: EditTask, steps: int) -> None:
        super().__init__(task.scene)
        self.task, self.steps = task, steps

    @abstractmethod
    def edit(self, cameras: CameraBatch, begin: Beginning | None = None) -> EditedImages:
        """The edited views at the model's own size; always the base is what is edited.

        Args:
            begin: None: sampled from noise.
        """

    @abstractmethod
    def unedited(self, cameras: CameraBatch) -> EditedImages:
        """What `edit` is given, at the model's own size."""

    def images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """The edited views; each costs a call of the network for every step of its sampling."""
        made = self.edit(cameras)
        self.task.extra_calls += len(cameras) * self.steps
        return resized(made, size)

    def base_images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """What was edited, through the same sizes."""
        return resized(self.unedited(cameras), size)

    def region_mask(self, cameras: CameraBatch, side: int, margin: int) -> Tensor:
        """(N, 1, side, side) of zeros and ones: where a focal region is seen, even behind the base, and `margin` pixels
        around."""
        masks = RegionViews(self.scene.parts, side, self.task.config.geometry.focal_band).render(cameras, 0)
        seen = (torch.stack(list(masks.values())).sum(dim=0) > 0).float()
        return torch.nn.functional.max_pool2d(seen, 2 * margin + 1, stride=1, padding=margin)


def resized(images: EditedImages, size: int) -> EditedImages:
    """The images at another size, smooth."""
    if images.mask.shape[-1] == size:
        return images

    def at_size(values: Tensor) -> Tensor:
        return interpolate(values, size=(size, size), mode="bilinear", antialias=True)

    return EditedImages(images.kind, at_size(images.values), at_size(images.mask))
