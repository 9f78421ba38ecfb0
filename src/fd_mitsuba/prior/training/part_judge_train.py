"""Training of the judge of parts, resumable at any time, and its accuracy on bodies that it has not seen."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, cross_entropy, pad

from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.evaluation.part_judge import NOTHING, PartClassifier, PartNetwork, save_judge
from fd_mitsuba.prior.data.catalogue import COARSE, FINE, Catalogue
from fd_mitsuba.prior.pictures.part_corpus import SEEDS_APART, SEEN_SEED, UNSEEN_SEED, Views, make_views
from fd_mitsuba.prior.training.training_folder import TrainingFolder, follow
from fd_mitsuba.training.stop_request import stop_on_signals

LEARNING_RATE = 2e-3
_BATCH = 96
_FIRST_BODIES, _LAST_BODY_AT = 27, 5 / 6
"""Bodies that are there at the first step, and the share of the schedule at which the last one comes in."""


@dataclass(frozen=True)
class JudgeKind:
    """What a judge of parts is trained for.

    Attributes:
        catalogue: whose bodies and parts.
        lump_share: see `make_views`.
        bodies: random ones, each with all of its parts.
        steps: length of the schedule.
        seed: which random bodies; judges of other seeds have none in common.
    """

    catalogue: Catalogue
    lump_share: float
    bodies: int
    steps: int
    seed: int

    @property
    def classes(self) -> tuple[str, ...]:
        return (*self.catalogue.part_weights, NOTHING)


JUDGE_KINDS = {
    "part_judge": JudgeKind(FINE, lump_share=0.5, bodies=900, steps=4000, seed=1),
    "part_judge_coarse": JudgeKind(COARSE, lump_share=0.0, bodies=500, steps=1600, seed=0),
}
"""By `--kind`: the judge that is shipped, and the one that benchmarks ask."""


def judge_kind(name: str) -> JudgeKind:
    """The kind of a name of `--kind`.

    Raises:
        UserError: there is none of that name.
    """
    if name not in JUDGE_KINDS:
        raise UserError(f"--kind {name}: no such judge of parts; give one of {', '.join(JUDGE_KINDS)}")
    return JUDGE_KINDS[name]


class Shelf:
    """The views of a training's random bodies, made once and kept in a folder."""

    def __init__(self, folder: Path, kind: JudgeKind) -> None:
        self._folder, self._kind = folder, kind
        self._made: list[Views] = []
        self._ends = np.zeros(0, np.int64)

    def fill(self, bodies: int) -> None:
        """Have at least so many bodies."""
        self._folder.mkdir(parents=True, exist_ok=True)
        for number in range(len(self._made), bodies):
            path = self._folder / f"{number:05d}.npz"
            if not path.is_file():
                names, seed = list(self._kind.catalogue.body_weights), SEEN_SEED + self._kind.seed * SEEDS_APART
                name = names[number % len(names)]
                views = make_views(name, seed + number, self._kind.catalogue, self._kind.lump_share)
                draft = path.with_suffix(".tmp.npz")
                np.savez_compressed(draft, **vars(views))
                os.replace(draft, path)
            with np.load(path) as data:
                self._made.append(Views(**data))
        self._ends = np.cumsum([len(views) for views in self._made])

    def batch(self, rng: np.random.Generator, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Random views before and after, and labels, of all bodies alike.

        Half of them mirrored, with noise and blur on what is seen after: samples of a prior and grown parts have both.
        """
        rows = np.sort(rng.integers(self._ends[-1], size=_BATCH))
        owner = np.searchsorted(self._ends, rows, side="right")
        taken = [(self._made[i], row - self._ends[i]) for i, row in zip(owner, rows, strict=True)]
        before, after = (
            torch.from_numpy(np.stack([getattr(views, name)[row] for views, row in taken])).float() / 127
            for name in ("before", "after")
        )
        mirrored = torch.from_numpy(rng.random(_BATCH) < 0.5)[:, None, None, None]
        sign = torch.tensor([-1.0, 1, 1, 1])[:, None, None]
        before, after = (torch.where(mirrored, (sign * x).flip(3), x) for x in (before, after))
        blur, noise = (
            torch.from_numpy(rng.uniform(0, most, _BATCH) * (rng.random(_BATCH) < share)).float()[:, None, None, None]
            for most, share in ((0.8, 0.5), (0.1, 0.6))
        )
        after = after + blur * (avg_pool2d(pad(after, (1, 1, 1, 1), mode="replicate"), 3, 1) - after)
        after = after + noise * torch.randn(after.shape, generator=generator)
        return before, after, torch.tensor([int(views.label[row]) for views, row in taken])


def train_part_judge(folder: Path, kind: JudgeKind, seconds: float, steps: int | None = None) -> None:
    """Train while random bodies come in, from the folder's checkpoint on where there is one; writes the judge at last.

    Args:
        folder: for `weights.safetensors` and `classes.json`; `checkpoint.pt`, `log.jsonl` and `views` lie beside.
        seconds: stop after this time at the latest, with a checkpoint.
        steps: length of the schedule; default: the kind's.

    Raises:
        Interrupted: after SIGINT or SIGTERM, with a checkpoint.
    """
    total, started = steps or kind.steps, time.monotonic()
    torch.manual_seed(0)
    network = PartNetwork(kind.classes).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=0.02, fused=True)
    average = {key: value.clone() for key, value in network.state_dict().items() if value.is_floating_point()}
    step = 0
    kept, shelf = TrainingFolder(folder), Shelf(folder / "views", kind)
    if (state := kept.load()) is not None:
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        average, step = state["average"], state["step"]
    rng, generator = np.random.default_rng([SEEN_SEED, kind.seed, step]), torch.Generator().manual_seed(step)

    def save() -> None:
        kept.save(
            {"network": network.state_dict(), "average": average, "optimiser": optimiser.state_dict(), "step": step}
        )

    losses: list[float] = []
    with stop_on_signals() as stop:
        while step < total and time.monotonic() - started < seconds and stop.name is None:
            shelf.fill(min(kind.bodies, _FIRST_BODIES + int(step / total / _LAST_BODY_AT * kind.bodies)))
            before, after, label = shelf.batch(rng, generator)
            rate = min(1.0, (step + 1) / 60) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / total)))
            for group in optimiser.param_groups:
                group["lr"] = LEARNING_RATE * float(rate)
            loss = cross_entropy(network(before, after), label, label_smoothing=0.02)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            step += 1
            follow(average, network, min(0.99, step / (step + 10)))
            losses.append(loss.item())
            if step % 50 == 0:
                kept.log({"step": step, "loss": round(float(np.mean(losses[-50:])), 4)})
            if kept.is_due():
                save()
    save()
    if stop.name is not None:
        raise Interrupted(f"{stop.name}: stopped after step {step} of {total}; the same command goes on")
    network.load_state_dict(average, strict=False)  # all but the counts of batches
    save_judge(network, folder)


def measure(judge: PartClassifier, kind: JudgeKind, rounds: int) -> dict:
    """Accuracy by single views of `rounds` unseen random bodies of each name: in all, by part and by body."""
    names = list(kind.catalogue.body_weights)
    views = [
        make_views(body, UNSEEN_SEED + kind.seed * SEEDS_APART + turn, kind.catalogue, kind.lump_share)
        for turn in range(rounds)
        for body in names
    ]
    before, after, label, body, closeup, blob = (
        np.concatenate(rows) for rows in zip(*map(_columns, views), strict=True)
    )
    right = judge(before / np.float32(127), after / np.float32(127)).argmax(1) == label

    def share(where: np.ndarray) -> float | None:
        return round(float(right[where].mean()), 3) if where.any() else None

    per_part = {}
    for number, name in enumerate(judge.classes):
        mine = (label == number) & ~blob
        per_part[name] = {
            "overview": share(mine & ~closeup),
            "closeup": share(mine & closeup),
            "views": int(mine.sum()),
        }
    return {
        "views": len(label),
        "accuracy": round(float(right.mean()), 4),
        "blobs_refused": share(blob),
        "per_part": per_part,
        "per_body": {name: share(body == i) for i, name in enumerate(names)},
    }


def _columns(views: Views) -> Iterator[np.ndarray]:
    return iter((views.before, views.after, views.label, views.body, views.closeup, views.blob))
