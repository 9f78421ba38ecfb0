"""What a training of a prior does with one batch: noise, the networks' answer, its error, and a step of the weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from diffusers import DDIMScheduler
from diffusers.models.attention_processor import AttnProcessor

from fd_mitsuba.prior.pictures.rounding import rounded
from fd_mitsuba.prior.training.kinds import Kind
from fd_mitsuba.prior.training.replicas import Replicas

ShareLoss = tuple[torch.Tensor, torch.Tensor]


def memory_format(place: torch.device) -> torch.memory_format:
    """How pictures lie in memory: channels last is faster on a processor, and on a card slower (65 against 81 ms)."""
    return torch.contiguous_format if place.type == "cuda" else torch.channels_last


class TrainingStep:
    """One step of the optimiser for one batch, all of it on the networks' device and without waiting for it.

    Args:
        modules: `text_encoder` and `unet`, in place already, the latter in `memory_format`.
        optimiser: a fused one.
        half: multiply in bfloat16.
        seed: of noise and times.

    Attributes:
        generator: what noise and times are drawn from.
    """

    def __init__(
        self,
        modules: torch.nn.ModuleDict,
        optimiser: torch.optim.AdamW,
        kind: Kind,
        scheduler: DDIMScheduler,
        half: bool,
        seed: int,
    ) -> None:
        place = next(modules.parameters()).device
        self._modules, self._optimiser, self._kind, self._half = modules, optimiser, kind, half
        self._alphas = scheduler.alphas_cumprod.to(place)
        self._format = memory_format(place)
        if place.type == "cpu":
            # As matrix products: the fused attention's backward pass takes a quarter of a step on a processor.
            modules["unet"].set_attn_processor(AttnProcessor())  # pyright: ignore
        self._threads = torch.get_num_threads() if place.type == "cpu" else 1
        self._replicas: dict[int, Replicas] = {}
        self.generator = torch.Generator(place).manual_seed(seed)

    def __call__(
        self,
        base: torch.Tensor,
        edited: torch.Tensor,
        changed: torch.Tensor,
        keep_base: torch.Tensor,
        tokens: torch.Tensor,
    ) -> torch.Tensor:
        """Change the weights, in place; a batch whose gradient is not finite leaves them as they are.

        Args:
            base: (N, C, L, L) in [-1, 1], what the network sees beside the noise, the base's latents last.
            edited: latents (N, 4, L, L) in [-1, 1].
            changed: the part's pixels (N, 1, L, L), 0 or 1.
            keep_base: (N, 1, 1, 1), 0 where the network must do without the base, else 1.
            tokens: (N, TEXT_LENGTH).

        Returns:
            Mean squared error on the whole and on the part (2,), detached.
        """
        kind, size = self._kind, len(base)
        place, generator = base.device, self.generator
        times = (1000 * torch.rand(size, generator=generator, device=place) ** kind.time_power).long().clamp(max=999)
        noise = torch.randn(edited.shape, generator=generator, device=place)
        if kind.masked_noise:
            masked = torch.rand(size, generator=generator, device=place) < kind.masked_noise
            noise = torch.where(masked[:, None, None, None], noise * changed, noise)
        seen, base = base * keep_base, base[:, -edited.shape[1] :]
        shown = edited
        if kind.rounded:
            chosen = torch.rand(size, generator=generator, device=place) < kind.rounded
            shown = torch.where(chosen[:, None, None, None], rounded(base, edited, changed, generator), edited)
        a = self._alphas[times][:, None, None, None]
        noisy = a.sqrt() * shown + (1 - a).sqrt() * noise
        target = edited if kind.prediction == "sample" else a.sqrt() * noise - (1 - a).sqrt() * edited
        condition = torch.cat([noisy, seen], 1).contiguous(memory_format=self._format)
        kept = seen[:, -4:] if kind.difference else torch.zeros_like(edited)
        batch = condition, times, tokens, target - kept, changed

        def share(modules: torch.nn.ModuleDict, samples: slice, batch: Sequence[torch.Tensor] = batch) -> ShareLoss:
            return share_loss(modules, kind, self._half, *(values[samples] for values in batch))

        error = torch.cat(self._shared_among(size).backward(share, size))
        norm = torch.nn.utils.clip_grad_norm_(self._modules.parameters(), 1.0)
        # A fused optimiser leaves the weights alone where this says 1; the card decides, so nobody waits for it.
        self._optimiser.found_inf = (~norm.isfinite()).float()  # pyright: ignore[reportAttributeAccessIssue]
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)
        return torch.stack([error.mean(), (error * changed).sum() / (4 * changed.sum() + 1)])

    def _shared_among(self, size: int) -> Replicas:
        threads = min(self._threads, size)
        if threads not in self._replicas:
            self._replicas[threads] = Replicas(self._modules, threads)
        return self._replicas[threads]


def share_loss(
    modules: torch.nn.ModuleDict,
    kind: Kind,
    half: bool,
    condition: torch.Tensor,
    times: torch.Tensor,
    tokens: torch.Tensor,
    wanted: torch.Tensor,
    changed: torch.Tensor,
) -> ShareLoss:
    """Mean loss of some samples, and the errors' squares (N, 4, H, W), detached."""
    # Without a cache of converted weights, which a recorded step must not take from an earlier one.
    with torch.autocast(condition.device.type, torch.bfloat16, enabled=half, cache_enabled=not condition.is_cuda):
        words = modules["text_encoder"](tokens).last_hidden_state
        away = modules["unet"](condition, times, words).sample.float() - wanted
    error = squared_error(away, kind.tint_weight)
    loss = (error * (1 + kind.part_weight * changed)).mean()
    if kind.copy_weight:
        loss = loss + kind.copy_weight * (away.abs() * (1 - changed)).mean()
    return loss, error.detach()


def squared_error(difference: torch.Tensor, tint_weight: float) -> torch.Tensor:
    """Squares of differences (N, 4, H, W); those of the first three channels from their mean count again, weighted."""
    if not tint_weight:
        return difference.square()
    tint = difference[:, :3] - difference[:, :3].mean(1, keepdim=True)
    return torch.cat([difference[:, :3].square() + tint_weight * tint.square(), difference[:, 3:].square()], dim=1)
