"""The views of one step of a stage, and whether their number suits the guidance."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.config import CamerasConfig, RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.views import CameraBatch, sample_views


class SeesMosaics(Protocol):
    """A guidance, as far as the choice of views is concerned."""

    @property
    def view_grid(self) -> int: ...


def views_at_once(guidance: SeesMosaics | None) -> int:
    """How many consecutive views the guidance sees at once, in one picture or as a group."""
    return 1 if guidance is None else guidance.view_grid**2 * getattr(guidance, "views_together", 1)


def check_views(stage: str, config: RunConfig, guidance: SeesMosaics | None) -> None:
    """UserError where a stage's views do not fill the guidance's mosaics or groups."""
    views, mosaic, count = getattr(config, stage).views, views_at_once(guidance), processes().count
    if count > 1 and views % (mosaic * count):
        raise UserError(
            f"{stage}.views = {views}: {count} processes share them, and {config.guidance.source} sees {mosaic} at "
            f"once; set {stage}.views to a multiple of {mosaic * count}, or start fewer processes"
        )
    if views % mosaic:
        raise UserError(
            f"{stage}.views = {views}: {config.guidance.source} sees {mosaic} views at once; "
            f"set {stage}.views to a multiple of {mosaic}"
        )


def step_views(
    settings: CamerasConfig,
    count: int,
    seed: int,
    focus: tuple[np.ndarray, float],
    aim: np.ndarray,
    guidance: SeesMosaics | None,
) -> tuple[CameraBatch, bool]:
    """`count` views for the seed, and whether they are close-ups.

    Args:
        focus: centre and radius of what close-ups show, canonical.
        aim: what the others look at, if `settings.aim` says so.
    """
    closeup = bool(np.random.default_rng((seed, 1)).random() < settings.focus_fraction)
    views = sample_views(
        settings,
        count,
        seed,
        focus=focus if closeup else None,
        centre=aim if settings.aim == "object" else None,
        together=views_at_once(guidance),
    )
    return views, closeup
