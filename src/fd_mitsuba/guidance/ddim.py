"""Sampling of latents with a guidance model: DDIM from noise, and the same with a part of the image held."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fd_mitsuba.guidance import sds

FIRST, LAST = 0.98, 0.02
"""Shares of the timesteps between which images are sampled: what the model is asked for when it guides, too."""


def timesteps(steps: int, levels: int, first: float = FIRST) -> list[int]:
    """`steps` falling timesteps of a schedule with `levels` of them, evenly spread from `first` to `LAST`."""
    high, low = (round(share * (levels - 1)) for share in (max(first, LAST), LAST))
    return [round(high + (low - high) * index / max(steps - 1, 1)) for index in range(steps)]


@torch.no_grad()
def sample(
    noise_in: Callable[[Tensor, Tensor], Tensor],
    alpha_bars: Tensor,
    noise: Tensor,
    steps: int,
    held: tuple[Tensor, Tensor] | None = None,
    seed: int = 0,
    first: float = FIRST,
) -> Tensor:
    """Clean latents (N, 4, L, L) after `steps` DDIM steps from noise (N, 4, L, L).

    Args:
        noise_in: z_t (N, 4, L, L), timesteps (N,) -> the noise that the network sees in z_t, guidance included.
        alpha_bars: of all timesteps, on the network's device.
        held: (N, 1, L, L) of zeros and ones and latents (N, 4, L, L). Outside of the ones, each step continues from
            these latents with noise of its level, and the result has them as they are (RePaint, arXiv 2201.09865,
            without its repeated steps).
        seed: of that noise.
        first: share of the timesteps at which `noise` is; below `FIRST`, latents with the noise of that timestep.
    """
    generator = torch.Generator().manual_seed(seed)
    times = timesteps(steps, len(alpha_bars), first)
    z, count = noise.to(alpha_bars.device), len(noise)
    for index, time in enumerate(times):
        now = torch.full((count,), time, device=alpha_bars.device)
        level = alpha_bars[now]
        noise_hat = noise_in(z.float(), now)
        last = index + 1 == len(times)
        following = None if last else alpha_bars[torch.full_like(now, times[index + 1])]
        if following is None:
            z = sds.clean_estimate(z, noise_hat, level)
        else:
            z = sds.ddim_step(z, noise_hat, level, following)
        if held is not None:
            inside, known = held
            if following is not None:
                fresh = torch.randn(known.shape, generator=generator).to(known.device)
                known = sds.add_noise(known, fresh, following)
            z = torch.where(inside > 0, z, known)
    return z
