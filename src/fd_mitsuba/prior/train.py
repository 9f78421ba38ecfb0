"""Training of the built-in prior: fresh mosaics every step, v-prediction, resumable at any time."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import deque
from pathlib import Path

import numpy as np
import torch

from fd_mitsuba.prior.bodies import BODIES
from fd_mitsuba.prior.corpus import Pair, make_pairs
from fd_mitsuba.prior.model import (
    build_scheduler,
    build_text_encoder,
    build_unet,
    encode_text,
    load_packed,
    tokenizer_of,
)
from fd_mitsuba.prior.parts import PARTS

CHANGED_WEIGHT = 4.0
"""Extra loss weight of pixels where the part is: they are few, and the rest is a copy."""

OFTEN = ("horse", "cat", "dog", "snowman", "mug", "bear", "deer", "person")
"""Bodies that most pictures show; the others keep the copying of the base general."""
_BODY_SHARES = np.array([4.0 if name in OFTEN else 1.0 for name in BODIES])
_BODY_SHARES /= _BODY_SHARES.sum()


class Pool:
    """The most recent pairs; every call to `refresh` renders one more body with a few of its parts."""

    def __init__(self, seed: int, capacity: int = 6000) -> None:
        self._rng = np.random.default_rng(seed)
        self._pairs: deque[Pair] = deque(maxlen=capacity)

    def refresh(self, count: int) -> None:
        """Render until `count` more pairs are there."""
        goal = count
        while goal > 0:
            body = str(self._rng.choice(list(BODIES), p=_BODY_SHARES))
            parts: list[str | None] = list(self._rng.permutation(list(PARTS))[:4])
            if self._rng.random() < 0.15:
                parts.append(None)
            made = make_pairs(body, parts, int(self._rng.integers(2**31)))
            self._pairs.extend(made)
            goal -= len(made)

    def batch(self, size: int) -> tuple[torch.Tensor, torch.Tensor, list[str]]:
        """Base and edited latents (size, 4, 64, 64) in [-1, 1], and captions; drawn at random, some mirrored."""
        chosen = [self._pairs[i] for i in self._rng.integers(len(self._pairs), size=size)]
        base = torch.from_numpy(np.stack([p.base for p in chosen])).float() / 127
        edited = torch.from_numpy(np.stack([p.edited for p in chosen])).float() / 127
        return base, edited, [p.caption for p in chosen]


def train(
    folder: Path,
    seconds: float,
    *,
    batch_size: int = 8,
    learning_rate: float = 8e-4,
    total_steps: int = 5000,
    seed: int = 0,
    init: Path | None = None,
) -> None:
    """Train until `total_steps` or for `seconds`, whichever is first; continue from `folder` if it holds a checkpoint.

    Args:
        folder: checkpoints and log; written every ten minutes and at the end.
        init: optional folder of packed weights to start from instead of random ones.
    """
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    scheduler, checkpoint = build_scheduler(), folder / "checkpoint.pt"
    fresh = not checkpoint.exists()
    if init is not None and fresh:
        shutil.copytree(init / "tokenizer", folder / "tokenizer", dirs_exist_ok=True)
    tokenizer = tokenizer_of(folder)
    encoder, unet = build_text_encoder(tokenizer), build_unet().to(memory_format=torch.channels_last)
    modules = torch.nn.ModuleDict({"text_encoder": encoder, "unet": unet})
    if init is not None and fresh:
        load_packed(init, modules)
    average = {k: v.clone() for k, v in modules.state_dict().items() if v.is_floating_point()}
    optimiser = torch.optim.AdamW(
        modules.parameters(), lr=learning_rate, betas=(0.9, 0.99), weight_decay=0.01, fused=True
    )
    step = 0
    if not fresh:
        state = torch.load(checkpoint, weights_only=True)
        modules.load_state_dict(state["modules"])
        optimiser.load_state_dict(state["optimiser"])
        average, step = state["average"], state["step"]
    alphas = scheduler.alphas_cumprod
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    pool = Pool(seed * 7919 + step)
    pool.refresh(min(3000, total_steps * batch_size))
    started, saved, smooth = time.time(), time.time(), None

    def save() -> None:
        torch.save(
            {"modules": modules.state_dict(), "optimiser": optimiser.state_dict(), "average": average, "step": step},
            folder / "checkpoint.tmp",
        )
        os.replace(folder / "checkpoint.tmp", checkpoint)

    while step < total_steps and time.time() - started < seconds:
        warm = min(1.0, (step + 1) / 150)
        rate = float(learning_rate * warm * (0.04 + 0.96 * 0.5 * (1 + np.cos(np.pi * step / total_steps))))
        for group in optimiser.param_groups:
            group["lr"] = rate
        base, edited, captions = pool.batch(batch_size)
        draw = torch.rand(batch_size, generator=generator).tolist()
        captions = ["" if u < 0.1 else c for u, c in zip(draw, captions, strict=True)]
        keep_base = torch.tensor([0.0 if 0.06 < u < 0.14 else 1.0 for u in draw])[:, None, None, None]
        times = (1000 * torch.rand(batch_size, generator=generator) ** 0.75).long().clamp(max=999)
        noise = torch.randn(edited.shape, generator=generator)
        a = alphas[times][:, None, None, None]
        noisy = a.sqrt() * edited + (1 - a).sqrt() * noise
        target = a.sqrt() * noise - (1 - a).sqrt() * edited
        condition = torch.cat([noisy, base * keep_base], 1).contiguous(memory_format=torch.channels_last)
        predicted = unet(condition, times, encode_text(tokenizer, encoder, captions)).sample
        changed = ((edited - base).abs().amax(1, keepdim=True) > 0.1).float()
        error = (predicted - target).square()
        loss = (error * (1 + CHANGED_WEIGHT * changed)).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(modules.parameters(), 1.0)
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        step += 1
        decay = min(0.998, step / (step + 10))
        with torch.no_grad():
            state = modules.state_dict()
            for key, value in average.items():
                value.lerp_(state[key], 1 - decay)
        on_part = ((error * changed).sum() / (4 * changed.sum() + 1)).item()
        now = (error.mean().item(), on_part)
        smooth = now if smooth is None else tuple(0.98 * s + 0.02 * n for s, n in zip(smooth, now, strict=True))
        pool.refresh(batch_size // 2)
        if step % 50 == 0:
            line = {
                "step": step,
                "loss": round(smooth[0], 5),
                "loss_part": round(smooth[1], 5),
                "rate": rate,
                "seconds": round(time.time() - started),
            }
            with open(folder / "log.jsonl", "a", encoding="utf-8") as log:
                log.write(json.dumps(line) + "\n")
        if time.time() - saved > 300:
            save()
            saved = time.time()
    save()
