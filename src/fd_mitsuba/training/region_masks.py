"""Where a step's views see the focal regions, for guidances that look at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from fd_mitsuba.config import RunConfig
from fd_mitsuba.guidance.interface import AppearanceViews
from fd_mitsuba.render.gbuffer import GBuffer
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


def shown_first(masks: Mapping[str, Tensor], seen: GBuffer) -> dict[str, Tensor]:
    """Masks of regions in which a pixel that shows a part counts for that part, whatever region is before it.

    The region of a pair of wings hides a crown from behind, and the wings themselves do not.

    Args:
        masks: part -> (B, 1, R, R), in the order of the G-buffer's parts.
        seen: what the same views show.
    """
    if len(masks) < 2:
        return dict(masks)
    side = next(iter(masks.values())).shape[-1]
    shares = adaptive_avg_pool2d(shown_parts(seen, len(masks)).squeeze(2), side)[:, :, None]
    free = 1 - shares.sum(0)
    return {name: own + free * mask for (name, mask), own in zip(masks.items(), shares, strict=True)}


def shown_parts(seen: GBuffer, count: int) -> Tensor:
    """(count, B, 1, S, S): 1 where a pixel shows the part of that number, the first of those that its samples hit."""
    views, _, size, _ = seen.alpha.shape
    shown = torch.zeros(count, views * size * size)
    shown[seen.part, seen.pixel] = (seen.part_mask.flatten()[seen.pixel] > 0).float()
    return shown.reshape(count, views, 1, size, size)


def one_by_one(views: AppearanceViews, shown: Mapping[str, Tensor]) -> list[AppearanceViews]:
    """The same views for each part in turn, as if the others belonged to the base, and with that part's text alone.

    A model that was trained on objects with one part takes all that is marked as new for one thing of one colour.

    Args:
        views: with a condition, and with regions of all parts.
        shown: part -> (B, 1, S, S), where it is seen.
    """
    assert views.condition is not None
    now, found = views.pictures.detach(), []
    for name, own in shown.items():
        regions = {part: torch.full_like(mask, float(part == name)) for part, mask in views.regions.items()}
        found.append(
            replace(
                views,
                condition=own * views.condition + (1 - own) * now,
                part_mask=own * views.part_mask,
                shine=own * views.shine,
                regions=regions,
            )
        )
    return found
