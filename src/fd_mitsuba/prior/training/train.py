"""Training of the built-in priors: fresh mosaics every step, resumable at any time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import avg_pool2d

from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.prior.training.kinds import GEOMETRY, Kind
from fd_mitsuba.prior.training.model import build_scheduler, build_tokenizer, tokenize
from fd_mitsuba.prior.training.pool import Pairs, Pool, WorkerPool
from fd_mitsuba.prior.training.replicas import Replicas
from fd_mitsuba.prior.training.training_folder import TrainingFolder, follow, smoothed
from fd_mitsuba.prior.training.warm_start import load_start
from fd_mitsuba.training.stop_request import stop_on_signals

LOG_EVERY = 50
ShareLoss = tuple[torch.Tensor, torch.Tensor]


def train(
    folder: Path,
    seconds: float,
    *,
    kind: Kind = GEOMETRY,
    batch_size: int = 8,
    total_steps: int | None = None,
    seed: int = 0,
    init: Path | None = None,
    pairs: Pairs | None = None,
    half: bool = False,
    device: str = "cpu",
    workers: int = 0,
) -> None:
    """Train until `total_steps` or for `seconds`, whichever is first; continue from `folder` if it holds a checkpoint.

    Args:
        folder: checkpoints and log; written every five minutes and at the end.
        kind: which prior.
        total_steps: length of the schedule; None: the kind's own.
        init: optional folder of packed weights to start from instead of random ones; no step is small then. A coarser
            prior's start a finer one, see `warm_start`.
        pairs: what to train on instead of freshly rendered pictures.
        half: multiply in bfloat16: faster on a processor that has it, slower on others.
        device: where the networks are, as torch names it; noise and times are drawn there.
        workers: processes that render pictures beside the training; 0: it renders them itself, between its steps.
    """
    total_steps = kind.steps if total_steps is None else total_steps
    files = TrainingFolder(folder)
    torch.manual_seed(seed)
    scheduler, state = build_scheduler(kind.prediction), files.load()
    tokenizer = build_tokenizer(kind.catalogue.vocabulary)
    modules, place = kind.build_modules(tokenizer), torch.device(device)
    if init is not None and state is None:
        load_start(init, modules, tokenizer, kind.prediction)
    modules.to(place)
    unet: Any = modules["unet"]
    unet.to(memory_format=torch.channels_last)
    average = {k: v.clone() for k, v in modules.state_dict().items() if v.is_floating_point()}
    optimiser = torch.optim.AdamW(
        modules.parameters(), lr=kind.learning_rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True
    )
    before = 0.0
    step, small_steps = 0, 0 if init is not None else kind.small_steps
    if state is not None:
        if state.get("kind", GEOMETRY.name) != kind.name:
            raise UserError(
                f"{files.checkpoint}: a training of another kind; continue it with --kind {state.get('kind')}"
            )
        if state["vocabulary"] != tokenizer.get_vocab():
            raise UserError(
                f"{files.checkpoint}: trained with another vocabulary; pack it as it was and start with --init"
            )
        modules.load_state_dict(state["modules"])
        optimiser.load_state_dict(state["optimiser"])
        average = {key: value.to(place) for key, value in state["average"].items()}
        step, before = state["step"], state.get("seconds", 0.0)
        small_steps = state.get("small_steps", kind.small_steps)
    replicas = Replicas(modules, min(torch.get_num_threads(), batch_size) if place.type == "cpu" else 1)
    alphas = scheduler.alphas_cumprod.to(place)
    generator = torch.Generator(place).manual_seed(seed * 1_000_003 + step)
    own_seed = seed * 7919 + step
    crew = WorkerPool(kind, own_seed, workers) if workers and pairs is None else None
    pool = crew or pairs or Pool(kind, own_seed)
    pool.refresh(min(600, total_steps * batch_size))
    started, smooth = time.time(), None

    def save() -> None:
        state = {"modules": modules.state_dict(), "optimiser": optimiser.state_dict(), "average": average}
        state |= {"step": step, "vocabulary": tokenizer.get_vocab(), "kind": kind.name, "small_steps": small_steps}
        state["seconds"] = before + time.time() - started
        files.save(state)

    with stop_on_signals() as stop:
        while step < total_steps and time.time() - started < seconds and stop.name is None:
            warm = min(1.0, (step + 1) / 150)
            rate = float(kind.learning_rate * warm * (0.04 + 0.96 * 0.5 * (1 + np.cos(np.pi * step / total_steps))))
            for group in optimiser.param_groups:
                group["lr"] = rate
            *pictures, captions = pool.batch(batch_size)
            base, edited, changed = (picture.to(place, non_blocking=True) for picture in pictures)
            if step < small_steps:
                base, edited = avg_pool2d(base, 2), avg_pool2d(edited, 2)
                changed = (avg_pool2d(changed, 2) > 0.4).float()
            draw = torch.rand(batch_size, generator=generator, device=place).tolist()
            captions = ["" if u < 0.1 else c for u, c in zip(draw, captions, strict=True)]
            keep_base = torch.tensor([0.0 if 0.06 < u < 0.14 else 1.0 for u in draw], device=place)[:, None, None, None]
            times = (
                (1000 * torch.rand(batch_size, generator=generator, device=place) ** kind.time_power)
                .long()
                .clamp(max=999)
            )
            noise = torch.randn(edited.shape, generator=generator, device=place)
            if kind.masked_noise:
                masked = torch.rand(batch_size, generator=generator, device=place) < kind.masked_noise
                noise = torch.where(masked[:, None, None, None], noise * changed, noise)
            a = alphas[times][:, None, None, None]
            noisy = a.sqrt() * edited + (1 - a).sqrt() * noise
            target = edited if kind.prediction == "sample" else a.sqrt() * noise - (1 - a).sqrt() * edited
            condition = torch.cat([noisy, base * keep_base], 1).contiguous(memory_format=torch.channels_last)
            kept = base * keep_base if kind.difference else torch.zeros_like(edited)
            batch = condition, times, tokenize(tokenizer, captions).to(place), target - kept, changed

            def share(modules: torch.nn.ModuleDict, samples: slice, batch: Sequence[torch.Tensor] = batch) -> ShareLoss:
                return share_loss(modules, kind, half, *(values[samples] for values in batch))

            error = torch.cat(replicas.backward(share, batch_size))
            torch.nn.utils.clip_grad_norm_(modules.parameters(), 1.0)
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
            step += 1
            follow(average, modules, min(0.998, step / (step + 10)))
            on_part = (error * changed).sum() / (4 * changed.sum() + 1)
            smooth = smoothed(smooth, tuple(torch.stack([error.mean(), on_part]).tolist()), 0.98)
            pool.refresh(kind.fresh_pairs)
            if step % LOG_EVERY == 0:
                line = {
                    "step": step,
                    "loss": round(smooth[0], 5),
                    "loss_part": round(smooth[1], 5),
                    "rate": rate,
                    "seconds": round(before + time.time() - started),
                }
                files.log(line)
            if files.is_due():
                save()
    save()
    if crew is not None:
        crew.close()
    if stop.name is not None:
        raise Interrupted(f"{stop.name}: stopped after step {step} of {total_steps}; the same command goes on")


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
    with torch.autocast(condition.device.type, torch.bfloat16, enabled=half):
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
