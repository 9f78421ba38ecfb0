"""Training of the built-in evaluator: pictures against captions, contrastively, resumable at any time.

Pictures and captions of a batch are matched both ways; a caption that happens to be true of several pictures belongs to
all of them. Half of a batch are the same body with other parts, the hardest to tell apart. Two aids that are dropped
afterwards make a small transformer learn from few pictures: its patches say which part they see, and its summary
which body and part there are. And for most of the training it sees only the patches that show something.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import affine_grid, avg_pool2d, cross_entropy, grid_sample, interpolate, log_softmax, normalize
from transformers import CLIPModel, PreTrainedTokenizerFast

from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.clip_captions import Claim, true_of, write_caption
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.pictures.clip_corpus import TRAINING_SEED, render_shards
from fd_mitsuba.prior.training.clip_model import WIDTH, build_clip, build_clip_tokenizer, save_evaluator
from fd_mitsuba.prior.training.training_folder import TrainingFolder, follow, smoothed
from fd_mitsuba.training.stop_request import stop_on_signals

KIND = "evaluator"
DATA = Path("runs") / "clip_data" / "training"
SHARDS, SEEDS_A_SHARD = 240, 8
GROUP = 6
"""Pictures of a batch that are taken from one body."""
KEPT_PATCHES = 28
ALL_PATCHES_FROM = 0.8
"""From this share of the training before it settles on, every patch is seen, as in use."""
LEARNING_RATE = 1.2e-3
STEPS = 12750
"""Length of the schedule unless another is asked for."""
SETTLING = 1 / 17
"""The last share of the training goes on from the averaged weights, at first at a quarter of the rate, with pictures
that show as many starts as parts: of what could be either, neither is the better guess any more. A whole training of
such pictures sees parts too seldom: it named 92 % of them instead of 98 %."""
EVEN_SHARDS = 120


class Shelf:
    """The pictures on disk; those still missing are rendered as the training goes on."""

    def __init__(self, folder: Path, seed: int, even: bool) -> None:
        self._folder, self._even, self._rng = folder, even, np.random.default_rng(seed)
        self._shards: dict[str, dict[str, np.ndarray]] = {}

    def fill(self, wanted: int) -> None:
        """Take in what is there, and render until there are `wanted` shards."""
        self._folder.mkdir(parents=True, exist_ok=True)
        for number in range(EVEN_SHARDS if self._even else SHARDS):
            path = self._folder / f"{TRAINING_SEED + number * SEEDS_A_SHARD}.npz"
            if path.name not in self._shards and (path.is_file() or len(self._shards) < wanted):
                first = TRAINING_SEED + number * SEEDS_A_SHARD
                list(render_shards(self._folder, first, SEEDS_A_SHARD, SEEDS_A_SHARD, self._even))
                with np.load(path) as arrays:
                    self._shards[path.name] = dict(arrays)

    def __len__(self) -> int:
        return len(self._shards)

    def batch(self, size: int) -> tuple[Tensor, np.ndarray, Tensor, list[str], np.ndarray]:
        """Pictures (size, 3, 64, 64) in [0, 1], what they show (size, 4), shares (size, 2, 8, 8), captions, claims."""
        rng, names = self._rng, list(self._shards)
        rows = []
        for _ in range(math.ceil(size / GROUP)):
            shard = self._shards[names[rng.integers(len(names))]]
            start = rng.integers(len(shard["shown"]))
            rows += [(shard, r % len(shard["shown"])) for r in start + rng.choice(36, GROUP, replace=False)]
        rows = rows[:size]
        pixels, shown = (np.stack([shard[name][r] for shard, r in rows]) for name in ("pixels", "shown"))
        shares = np.stack([np.stack([shard["part_share"][r], shard["body_share"][r]]) for shard, r in rows])
        written = [write_caption(Claim(*map(int, row)), rng) for row in shown]
        captions, claims = [text for text, _ in written], np.array([claim for _, claim in written])
        pictures = torch.from_numpy(pixels).permute(0, 3, 1, 2).float() / 255
        return pictures, shown.astype(int), torch.from_numpy(shares).float() / 255, captions, claims


def augmented(pictures: Tensor, shares: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The pictures zoomed, shifted, turned, some of them blurred, all with a little noise; the shares likewise."""
    count = len(pictures)
    draw = torch.rand(count, 6, generator=generator) * 2 - 1
    angle, zoom = 0.08 * draw[:, 0], 1 + 0.14 * draw[:, 1]
    cosine, sine, shift = angle.cos() * zoom, angle.sin() * zoom, 0.1 * draw[:, 2:4]
    theta = torch.stack(
        [torch.stack([cosine, -sine, shift[:, 0]], 1), torch.stack([sine, cosine, shift[:, 1]], 1)], dim=1
    )

    def moved(x: Tensor, padding: str) -> Tensor:
        return grid_sample(x, affine_grid(theta, list(x.shape), False), padding_mode=padding, align_corners=False)

    pictures, shares = moved(pictures, "border"), moved(shares, "zeros")
    small = interpolate(avg_pool2d(pictures, 2), scale_factor=2, mode="bilinear", align_corners=False)
    strength = (draw[:, 4] - 0.2).clamp(min=0).view(-1, 1, 1, 1)
    pictures = pictures + strength * (small - pictures)
    noise = torch.randn(pictures.shape, generator=generator) * (0.02 * draw[:, 5].abs().view(-1, 1, 1, 1))
    return (pictures + noise).clamp(0, 1), shares


def see(model: CLIPModel, pictures: Tensor, shares: Tensor, kept: int | None) -> tuple[Tensor, Tensor, Tensor]:
    """Picture features (N, D), summaries (N, width), patch states (N, K, width) of the `kept` fullest patches."""
    vision = model.vision_model
    states = vision.embeddings(pictures * 2 - 1)
    if kept is not None:
        order = _fullest(shares, kept)[..., None].expand(-1, -1, states.shape[-1])
        states = torch.cat([states[:, :1], states[:, 1:].gather(1, order)], dim=1)
    states = vision.encoder(inputs_embeds=vision.pre_layrnorm(states)).last_hidden_state
    summary = vision.post_layernorm(states[:, 0])
    return model.visual_projection(summary), summary, states[:, 1:]


def contrastive_loss(similarities: Tensor, matches: Tensor) -> Tensor:
    """Mean of both cross-entropies between scaled similarities (N, M) and the matches (N, M), spread evenly.

    Rows or columns always have a match, since every caption was written for one of the pictures.
    """
    target = matches.float()
    by_picture = -(target / target.sum(1, keepdim=True) * log_softmax(similarities, 1)).sum(1).mean()
    by_caption = -(target / target.sum(0, keepdim=True) * log_softmax(similarities, 0)).sum(0).mean()
    return (by_picture + by_caption) / 2


def aid_loss(aids: torch.nn.ModuleDict, summary: Tensor, patches: Tensor, share: Tensor, shown: Tensor) -> Tensor:
    """How well patches (N, K, width) tell the part that covers a share (N, K) of them, and summaries what there is."""
    none = len(PARTS)
    part = torch.where(shown[:, 1] < 0, none, shown[:, 1])
    here = torch.where(share > 0.12, part[:, None], none)
    weight = torch.ones(none + 1)
    weight[none] = 0.25
    by_patch = cross_entropy(aids["patch"](patches).flatten(0, 1), here.flatten(), weight=weight)
    return by_patch + cross_entropy(aids["part"](summary), part) + cross_entropy(aids["body"](summary), shown[:, 0])


def train_evaluator(
    folder: Path,
    seconds: float,
    *,
    total_steps: int = STEPS,
    batch_size: int = 64,
    seed: int = 0,
    data: Path = DATA,
    least_shards: int = 4,
) -> None:
    """Train until `total_steps` or for `seconds`, whichever is first; continue from `folder` if it holds a checkpoint.

    The learning rate falls to nothing by then, so a shorter training is a complete one, only a worse one.

    Args:
        folder: `checkpoint.pt` and `log.jsonl`, written every five minutes and at the end.
        data: where the pictures are kept, rendered when they are missing.
        least_shards: before the first step; the others come little by little during the training. Those of the last
            part of it are kept in a folder `even` among them.

    Raises:
        Interrupted: after SIGINT or SIGTERM, with a checkpoint.
        UserError: the folder holds a training of something else or with other words.
    """
    files = TrainingFolder(folder)
    torch.manual_seed(seed)
    tokenizer, state = build_clip_tokenizer(), files.load()
    model = build_clip(tokenizer)
    heads = {"patch": len(PARTS) + 1, "part": len(PARTS) + 1, "body": len(BODIES)}
    aids = torch.nn.ModuleDict({name: torch.nn.Linear(WIDTH, count) for name, count in heads.items()})
    modules = torch.nn.ModuleDict({"clip": model, "aids": aids})
    optimiser = _optimiser(modules)
    average, step = {k: v.clone() for k, v in model.state_dict().items() if v.is_floating_point()}, 0
    before, began = 0.0, 0
    if state is not None:
        if state.get("kind") != KIND or state["vocabulary"] != tokenizer.get_vocab():
            raise UserError(f"{files.checkpoint}: another kind of training, or other words; choose another folder")
        modules.load_state_dict(state["modules"])
        optimiser.load_state_dict(state["optimiser"])
        average, step, before, began = state["average"], state["step"], state["seconds"], state.get("began", 0)
    generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
    shelf, started, smooth = Shelf(data, seed * 7919 + step, even=False), time.time(), None
    even = Shelf(data / "even", seed * 7919 + step, even=True)

    def save() -> None:
        state = {"modules": modules.state_dict(), "optimiser": optimiser.state_dict(), "average": average}
        state |= {"step": step, "began": began, "vocabulary": tokenizer.get_vocab(), "kind": KIND}
        state["seconds"] = before + time.time() - started
        files.save(state)

    with stop_on_signals() as stop:
        while step < total_steps and time.time() - started < seconds and stop.name is None:
            progress = max(step / total_steps, (time.time() - started) / seconds)
            settling = progress >= 1 - SETTLING
            if settling and not began:
                began, optimiser = step, _optimiser(modules)
                model.load_state_dict(average, strict=False)
            began = began if settling else 0
            progress = (progress + SETTLING - 1) / SETTLING if settling else progress / (1 - SETTLING)
            on_shelf, shards = (even, EVEN_SHARDS) if settling else (shelf, SHARDS)
            if step % 10 == 0 or not len(on_shelf):
                on_shelf.fill(max(least_shards, math.ceil(progress * shards)))
            rate = LEARNING_RATE * (0.25 if settling else 1) * min(1.0, (step - began + 1) / 60)
            for group in optimiser.param_groups:
                group["lr"] = rate * (0.01 + 0.495 * (1 + math.cos(math.pi * progress)))
            pictures, shown, shares, captions, claims = on_shelf.batch(batch_size)
            pictures, shares = augmented(pictures, shares, generator)
            kept = None if settling or progress >= ALL_PATCHES_FROM else KEPT_PATCHES
            image, summary, patches = see(model, pictures, shares, kept)
            text = read(model, tokenizer, captions)
            scale = model.logit_scale.exp().clamp(max=50)
            matches = torch.from_numpy(true_of(claims, shown))
            contrast = contrastive_loss(scale * normalize(image, dim=-1) @ normalize(text, dim=-1).T, matches)
            share = shares[:, 0].flatten(1)
            share = share if kept is None else share.gather(1, _fullest(shares, kept))
            aid = aid_loss(aids, summary, patches, share, torch.from_numpy(shown))
            (contrast + 0.5 * aid).backward()
            torch.nn.utils.clip_grad_norm_(modules.parameters(), 1.0)
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
            step += 1
            follow(average, model, min(0.995, (step - began) / (step - began + 10)))
            smooth = smoothed(smooth, (contrast.item(), aid.item()), 0.97)
            if step % 25 == 0:
                line = {"step": step, "contrast": round(smooth[0], 4), "aid": round(smooth[1], 4)}
                line |= {
                    "scale": round(scale.item(), 1),
                    "shards": len(on_shelf),
                    "seconds": round(before + time.time() - started),
                }
                files.log(line)
            if files.is_due():
                save()
    save()
    if stop.name is not None:
        raise Interrupted(f"{stop.name}: stopped after step {step} of {total_steps}; the same command goes on")


def _optimiser(modules: torch.nn.Module) -> torch.optim.AdamW:
    return torch.optim.AdamW(modules.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.98), weight_decay=0.03)


def read(model: CLIPModel, tokenizer: PreTrainedTokenizerFast, captions: list[str]) -> Tensor:
    """Text features (N, D); gradients flow."""
    tokens = tokenizer(captions, padding=True, truncation=True, return_tensors="pt")
    pooled = model.text_model(input_ids=tokens.input_ids, attention_mask=tokens.attention_mask).pooler_output
    return model.text_projection(pooled)


def pack_evaluator(state: dict[str, Any], folder: Path) -> None:
    """Write the averaged weights in a checkpoint's content as a CLIP folder."""
    model = build_clip(build_clip_tokenizer())
    missing = model.load_state_dict(state["average"], strict=False).missing_keys
    if any("position_ids" not in key for key in missing):
        raise ValueError(f"a checkpoint that lacks {missing}")
    save_evaluator(model, folder, {"steps": state["step"], "training_seconds": round(state["seconds"])})


def _fullest(shares: Tensor, kept: int) -> Tensor:
    return shares.sum(1).flatten(1).topk(kept, dim=1).indices
