"""The variants of `guidance.variant`: how a diffusion model's noise becomes a gradient for clean latents.

An entry of `VARIANTS` each, with its own settings: `guidance.variant = {kind = "ism", interval = 0.1}`.

Symbols as in `sds` and `query`; g is the gradient with respect to z, z_hat the clean latents it pulls towards.
"""

from __future__ import annotations

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig, Section
from fd_mitsuba.config.registry import Registry
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.query import Pass, Query, Variant

VARIANTS: Registry[type[Variant]] = Registry("variants", "guidance variant")
"""Called with their settings."""


@VARIANTS.register("sds")
class ScoreDistillation(Variant):
    """g = w(t) (e_hat(z_t) - e): SDS (DreamFusion, arXiv 2209.14988; the paper's section "Preliminary")."""

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        timesteps = query.chunk.timesteps
        z_t = query.noised(timesteps)
        noise_hat = query.guided(z_t, timesteps)
        preview = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(timesteps))
        return sds.sds_gradient(noise_hat, query.noise, query.weights()), preview


@VARIANTS.register("csd")
class ClassifierScore(Variant):
    """g = w(t) (e(text; z_t) - e(free; z_t)): CSD (arXiv 2310.19415). The guidance scale plays no part in it."""

    passes = ("text", "free")

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        timesteps = query.chunk.timesteps
        z_t = query.noised(timesteps)
        seen = query.passes(z_t, timesteps, ("text", query.free))
        preview = sds.clean_estimate(z_t, seen["text"], query.alpha_bar(timesteps))
        return sds.csd_gradient(seen["text"], seen[query.free], query.weights()), preview


class IntervalSettings(Section):
    """Of `ism`."""

    interval: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Distance between the two noise levels that are compared, as a share of all timesteps."""
    inversion_step: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Stride of the DDIM inversion up to the lower of them; each stride is one pass of the network."""


@VARIANTS.register("ism", IntervalSettings)
class IntervalScore(Variant):
    """g = w(t) (e_hat(z_t) - e(free; z_s)): ISM (LucidDreamer, arXiv 2311.11284).

    s = t - delta_T. z_s is z carried from timestep 0 to s by DDIM inversion in steps of delta_S, z_t is z_s carried one
    step further, both by e(free): the drawn noise enters at timestep 0 only, where there is next to none. A picture
    whose s is reached waits for its neighbours, and its result does not depend on them.
    """

    passes = ("guided", "free")
    settings: IntervalSettings

    def asked(self, timestep_range: tuple[float, float], together: int) -> dict[Pass, float]:
        """Strides up to the highest s of the pictures at hand, of t that are evenly distributed."""
        low, high = timestep_range
        interval, stride = self.settings.interval, self.settings.inversion_step
        width, strides, begin = max(high - low, 1e-9), 0.0, 0.0
        while begin < high - interval:  # one more stride is taken where any s lies beyond
            below = min(max((begin + interval - low) / width, 0.0), 1.0)
            strides += 1 - below**together
            begin += stride
        return {"guided": 1.0, "free": 1.0 + strides}

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        last, own = len(query.network.alpha_bars) - 1, self.settings
        interval, stride = (max(1, round(share * last)) for share in (own.interval, own.inversion_step))
        end = query.chunk.timesteps
        start = (end - interval).clamp(min=0)
        now = torch.zeros_like(end)
        z_s = query.noised(now)
        for _ in range(-(-int(start.max()) // stride)):
            following = torch.minimum(now + stride, start)
            moved = query.move(z_s, query.passes(z_s, now, (query.free,))[query.free], now, following)
            z_s = torch.where((following > now).view(-1, 1, 1, 1), moved, z_s)
            now = following
        noise_start = query.passes(z_s, start, (query.free,))[query.free]
        z_t = query.move(z_s, noise_start, start, end)
        noise_hat = query.guided(z_t, end)
        preview = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(end))
        return sds.sds_gradient(noise_hat, noise_start, query.weights()), preview


class ReconstructionSettings(Section):
    """Of `reconstruction`."""

    steps: Annotated[int, Field(ge=1, le=50)] = 4
    """DDIM steps from z_t to the clean latents."""


@VARIANTS.register("reconstruction", ReconstructionSettings)
class Reconstruction(Variant):
    """g = w(t) (z - z_hat), z_hat after DDIM steps from z_t by e_hat (HiFA, arXiv 2305.18766).

    With many steps z_hat is the edited picture of an iterative dataset update (Instruct-NeRF2NeRF, arXiv 2303.12789).
    The steps are evenly spaced from t to the clean latents.
    """

    settings: ReconstructionSettings

    def asked(self, timestep_range: tuple[float, float], together: int) -> dict[Pass, float]:
        """One pass of each kind for a step of DDIM."""
        return {"guided": float(self.settings.steps)}

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        now, steps = query.chunk.timesteps, self.settings.steps
        z_t = query.noised(now)
        noise_hat = query.guided(z_t, now)
        for remaining in range(steps - 1, 0, -1):
            following = query.chunk.timesteps * remaining // steps
            z_t = query.move(z_t, noise_hat, now, following)
            now = following
            noise_hat = query.guided(z_t, now)
        z_hat = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(now))
        return sds.reconstruction_gradient(query.chunk.z, z_hat, query.weights()), z_hat


class VariationalSettings(Section):
    """Of `vsd`."""

    rank: Annotated[int, Field(ge=1, le=64)] = 4
    """Of the critic's change of each matrix."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 1e-4
    """Of the critic."""


@VARIANTS.register("vsd", VariationalSettings)
class VariationalScore(Variant):
    """g = w(t) (e_hat(z_t) - e_critic(z_t)): VSD (ProlificDreamer, arXiv 2305.16213).

    e_critic is the network with a LoRA that learns, one step after each, to see the noise in the step's own latents at
    timesteps from the whole range. It reads the prompt, with the word for the view, where ProlificDreamer tells it the
    camera; it starts anew in each phase.
    """

    passes = ("guided", "text")
    learns = True
    settings: VariationalSettings

    def asked(self, timestep_range: tuple[float, float], together: int) -> dict[Pass, float]:
        """What the critic sees, and its lesson forward and back."""
        return {"guided": 1.0, "text": 3.0}

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        timesteps = query.chunk.timesteps
        z_t = query.noised(timesteps)
        noise_hat = query.guided(z_t, timesteps)
        preview = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(timesteps))
        return sds.sds_gradient(noise_hat, query.criticised(z_t, timesteps), query.weights()), preview


def refuse_conflicts(config: GuidanceConfig) -> None:
    """UserError where settings do not go with the variant."""
    variant = VARIANTS.make(config.variant, "guidance.variant")
    if config.perp_neg and "guided" not in variant.passes:
        raise UserError(
            f"guidance.perp_neg = {config.perp_neg:g}: {config.variant.kind} makes no use of it; set it to 0"
        )
    if variant.learns and config.dtype == "float16":
        raise UserError(
            f"guidance.variant = {config.variant.kind}: what its critic learns is too small for float16; set "
            "guidance.dtype to bfloat16 or float32"
        )


def critic_rank(config: GuidanceConfig) -> int:
    """Rank of the critic that the variant of these settings learns with; 0: it has none."""
    variant = VARIANTS.make(config.variant, "guidance.variant")
    return variant.settings.rank if variant.learns else 0
