"""What is random in a step of guidance: timesteps and noise, the same however the views are shared out or chunked."""

from __future__ import annotations

from typing import get_args

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews, Phase


def step_generator(seed: int, step: int, phase: Phase, *purpose: int) -> torch.Generator:
    """Random numbers of a step; each purpose beside t and the noise has its own."""
    key = np.random.SeedSequence((seed, step, get_args(Phase).index(phase), *purpose))
    return torch.Generator().manual_seed(int(key.generate_state(1, np.uint64)[0] >> 1))


def own_share(views: GuidanceViews | AppearanceViews) -> tuple[slice, int]:
    """Which of the step's views these are, and how many there are in all processes."""
    own = len(views.pictures)
    if views.share is None:
        return slice(0, own), own
    return views.share, own * processes().count


def drawn_timesteps(
    config: GuidanceConfig,
    bounds: tuple[float, float],
    levels: int,
    count: int,
    progress: float,
    generator: torch.Generator,
) -> Tensor:
    """(count,) int64 on the CPU, random or, with `timestep_annealing`, the one that is due.

    Args:
        config: says which.
        bounds: least and greatest, as shares of `levels`.
        levels: the model's training timesteps.
        count: of pictures.
        progress: of the phase, in [0, 1].
        generator: of `step_generator`.
    """
    if config.timestep_annealing == "none":
        return sds.draw_timesteps(bounds, levels, count, generator)
    return sds.scheduled_timesteps(bounds, levels, count, config.timestep_annealing, progress)
