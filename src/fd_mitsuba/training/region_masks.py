"""Where a step's views see the focal regions, for guidances that look at them."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from fd_mitsuba.config import RunConfig
from fd_mitsuba.render.region_views import RegionViews
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for


class RegionMasks:
    """The masks of `GuidanceViews.regions`; empty for a guidance that has no `region_size`.

    The regions count with the band in which `loss_focal` lets a part overrun them.
    """

    def __init__(self, scene: EditScene, config: RunConfig, guidance: Any) -> None:
        self._scene, self._config, self._guidance = scene, config, guidance
        self._views: RegionViews | None = None

    def __call__(self, cameras: CameraBatch, step: int, first: int) -> dict[str, Tensor]:
        """Part -> (B, 1, R, R), the share of each pixel in which one of its focal regions comes first.

        Args:
            first: which of the step's views the first one is.
        """
        size = getattr(self._guidance, "region_size", None)
        if size is None:
            return {}
        if self._views is None:
            self._views = RegionViews(self._scene.parts, size, self._config.geometry.focal_band)
        return self._views.render(cameras, seed_for(self._config.seed, Purpose.REGIONS, step) + first)
