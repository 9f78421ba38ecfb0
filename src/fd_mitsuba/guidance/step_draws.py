"""What is random in a step of guidance: timesteps and noise, the same however the views are shared out or chunked."""

from __future__ import annotations

from collections.abc import Callable
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


class StepDraws:
    """Timesteps (N,) int64 and noise (N, 4, L, L) of pictures; drawn on the CPU, so that no device changes them.

    Args:
        config: random timesteps or, with `timestep_annealing`, the one that is due.
        bounds: of the timesteps of a phase, drafted or not, as shares of `levels`.
        levels: the model's training timesteps.
        latent_size: cells a side of the latents.
        view_grid: pictures are mosaics of view_grid x view_grid views.
        together: consecutive pictures that are seen at once and have one timestep, as in the training of such models.
        device: where they go.
    """

    def __init__(
        self,
        config: GuidanceConfig,
        bounds: Callable[[Phase, bool], tuple[float, float]],
        levels: int,
        latent_size: int,
        view_grid: int,
        together: int,
        device: torch.device,
    ) -> None:
        self._config, self._bounds, self._levels = config, bounds, levels
        self._shape = (4, latent_size, latent_size)
        self._views, self._together, self._device = view_grid**2, together, device

    def of_step(
        self, count: int, step: int, steps_total: int, phase: Phase, seed: int, drafted: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Of all `count` pictures of a step."""
        generator, bounds = step_generator(seed, step, phase), self._bounds(phase, drafted)
        groups, annealing = count // self._together, self._config.timestep_annealing
        if annealing == "none":
            timesteps = sds.draw_timesteps(bounds, self._levels, groups, generator)
        else:
            progress = min(step / max(steps_total - 1, 1), 1.0)
            timesteps = sds.scheduled_timesteps(bounds, self._levels, groups, annealing, progress)
        return self._with_noise(timesteps, generator)

    def of_views(
        self, views: GuidanceViews | AppearanceViews, step: int, steps_total: int, phase: Phase, seed: int
    ) -> tuple[Tensor, Tensor]:
        """`of_step` for these of the step's views."""
        count, drafted = own_share(views)[1] // self._views, isinstance(views, GuidanceViews) and views.drafted
        return self._own(views, *self.of_step(count, step, steps_total, phase, seed, drafted))

    def lesson(
        self, views: GuidanceViews | AppearanceViews, step: int, phase: Phase, seed: int
    ) -> tuple[Tensor, Tensor]:
        """What a critic is taught these views with: timesteps from the whole range."""
        generator = step_generator(seed, step, phase, 2)
        groups = own_share(views)[1] // self._views // self._together
        timesteps = torch.randint(1, self._levels, (groups,), generator=generator)
        return self._own(views, *self._with_noise(timesteps, generator))

    def _with_noise(self, timesteps: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        timesteps = timesteps.repeat_interleave(self._together)
        noise = torch.randn((len(timesteps), *self._shape), generator=generator)
        return timesteps.to(self._device), noise.to(self._device)

    def _own(self, views: GuidanceViews | AppearanceViews, timesteps: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        share = own_share(views)[0]
        own = slice(share.start // self._views, share.stop // self._views)
        return timesteps[own], noise[own]
