"""Training of the built-in priors: fresh mosaics every step, resumable at any time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import avg_pool2d

from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.prior.training.kinds import GEOMETRY, Kind
from fd_mitsuba.prior.training.model import TokenRows, build_scheduler, build_tokenizer
from fd_mitsuba.prior.training.pool import Pairs, Pool, WorkerPool
from fd_mitsuba.prior.training.recorded_step import RecordedStep
from fd_mitsuba.prior.training.step import TrainingStep, memory_format
from fd_mitsuba.prior.training.training_folder import TrainingFolder, follow, require_same_shapes
from fd_mitsuba.prior.training.warm_start import load_start
from fd_mitsuba.training.stop_request import stop_on_signals

LOG_EVERY = 50


def train(
    folder: Path,
    seconds: float,
    *,
    kind: Kind = GEOMETRY,
    batch_size: int = 8,
    total_steps: int | None = None,
    rate: float | None = None,
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
        rate: highest learning rate; None: the kind's own, which goes with small batches.
        init: optional folder of packed weights to start from instead of random ones; no step is small then. A coarser
            prior's start a finer one, see `warm_start`.
        pairs: what to train on instead of freshly rendered pictures.
        half: multiply in bfloat16: faster on a processor that has it, slower on others.
        device: where the networks are, as torch names it; noise and times are drawn there.
        workers: processes that render pictures beside the training; 0: it renders them itself, between its steps.

    Raises:
        UserError: the folder holds another training, or no step learns any more.
        Interrupted: by a signal; the checkpoint is written.
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
    unet.to(memory_format=memory_format(place))
    average = {k: v.clone() for k, v in modules.state_dict().items() if v.is_floating_point()}
    on_card = place.type == "cuda"
    # A recorded step reads its rate from the card.
    highest = kind.learning_rate if rate is None else rate
    first_rate = torch.tensor(highest, device=place) if on_card else highest
    optimiser = torch.optim.AdamW(
        modules.parameters(), lr=first_rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True, capturable=on_card
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
        require_same_shapes(files.checkpoint, state["modules"], modules)
        modules.load_state_dict(state["modules"])
        optimiser.load_state_dict(state["optimiser"])
        for group in optimiser.param_groups:
            group |= {"lr": first_rate, "capturable": on_card}
        average = {key: value.to(place) for key, value in state["average"].items()}
        step, before = state["step"], state.get("seconds", 0.0)
        small_steps = state.get("small_steps", kind.small_steps)
    step_of_batch: Any = TrainingStep(modules, optimiser, kind, scheduler, half, seed * 1_000_003 + step)
    if on_card:
        step_of_batch = RecordedStep(step_of_batch, step_of_batch.generator)
    drops = torch.Generator().manual_seed(seed * 1_000_003 + step)
    own_seed = seed * 7919 + step
    crew = WorkerPool(kind, own_seed, workers, device=place) if workers and pairs is None else None
    pool = crew or pairs or Pool(kind, own_seed)
    pool.refresh(min(600, total_steps * batch_size))
    rows = TokenRows(tokenizer)
    started, smooth = time.time(), None
    skipped, skipped_before = torch.zeros((), dtype=torch.long, device=place), 0

    def save() -> None:
        state = {"modules": modules.state_dict(), "optimiser": optimiser.state_dict(), "average": average}
        state |= {"step": step, "vocabulary": tokenizer.get_vocab(), "kind": kind.name, "small_steps": small_steps}
        state["seconds"] = before + time.time() - started
        files.save(state)

    with stop_on_signals() as stop:
        while step < total_steps and time.time() - started < seconds and stop.name is None:
            warm = min(1.0, (step + 1) / 150)
            now = float(highest * warm * (0.04 + 0.96 * 0.5 * (1 + np.cos(np.pi * step / total_steps))))
            for group in optimiser.param_groups:
                group["lr"] = group["lr"].fill_(now) if isinstance(group["lr"], torch.Tensor) else now
            *pictures, captions = pool.batch(batch_size)
            draw = torch.rand(batch_size, generator=drops)
            captions = ["" if u < 0.1 else c for u, c in zip(draw.tolist(), captions, strict=True)]
            keep_base = (~((draw > 0.06) & (draw < 0.14))).float()[:, None, None, None]
            base, edited, changed, keep_base, tokens = (
                values.to(place, non_blocking=True) for values in (*pictures, keep_base, rows(captions))
            )
            if step < small_steps:
                base, edited = avg_pool2d(base, 2), avg_pool2d(edited, 2)
                changed = (avg_pool2d(changed, 2) > 0.4).float()
            losses = step_of_batch(base, edited, changed, keep_base, tokens)
            step += 1
            follow(average, modules, min(0.998, step / (step + 10)))
            finite = losses.isfinite().all()
            skipped += ~finite
            smooth = losses.clone() if smooth is None else torch.where(finite, smooth.lerp(losses, 0.02), smooth)
            pool.refresh(kind.fresh_pairs)
            if step % LOG_EVERY == 0:
                on_all, on_part, in_all = *smooth.tolist(), int(skipped)
                if in_all - skipped_before == LOG_EVERY:
                    raise UserError(
                        f"{files.checkpoint}: {LOG_EVERY} steps in a row had a loss that is not finite; "
                        "start anew with a lower --rate, or without --bf16"
                    )
                skipped_before = in_all
                line = {
                    "step": step,
                    "loss": round(on_all, 5),
                    "loss_part": round(on_part, 5),
                    "skipped": in_all,
                    "rate": now,
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
