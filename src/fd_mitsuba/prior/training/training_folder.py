"""What a training of the prior or its evaluator keeps on the disk: a checkpoint to go on from, and its log."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from fd_mitsuba.errors import UserError

_SAVE_EVERY_SECONDS = 300


class TrainingFolder:
    """`checkpoint.pt` and `log.jsonl` in a folder, which is made.

    Attributes:
        checkpoint: the path of the former.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.checkpoint, self._log, self._saved = folder / "checkpoint.pt", folder / "log.jsonl", time.time()

    def load(self) -> dict[str, Any] | None:
        """What was saved last; None in a new folder."""
        return torch.load(self.checkpoint, weights_only=True) if self.checkpoint.exists() else None

    def save(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint, whole or not at all."""
        draft = self.checkpoint.with_suffix(".tmp")
        torch.save(state, draft)
        os.replace(draft, self.checkpoint)
        self._saved = time.time()

    def is_due(self) -> bool:
        """Whether nothing was saved for five minutes."""
        return time.time() - self._saved > _SAVE_EVERY_SECONDS

    def log(self, line: dict[str, Any]) -> None:
        """Add a line to the log."""
        with open(self._log, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def require_same_shapes(checkpoint: Path, weights: Mapping[str, torch.Tensor], modules: torch.nn.Module) -> None:
    """UserError where a checkpoint's weights are of networks of other shapes: an earlier version's of the same kind."""
    own = modules.state_dict()
    other = [name for name, value in weights.items() if name in own and own[name].shape != value.shape]
    if other:
        raise UserError(
            f"{checkpoint}: {other[0]} is of shape {tuple(weights[other[0]].shape)}, not "
            f"{tuple(own[other[0]].shape)}: an earlier version's networks; pack it with that version, and start from "
            "the packed folder with --init"
        )


def follow(average: dict[str, torch.Tensor], module: torch.nn.Module, decay: float) -> None:
    """Move the averaged weights towards the module's, in place: average = decay average + (1 - decay) weights."""
    with torch.no_grad():
        current = module.state_dict()
        torch._foreach_lerp_(list(average.values()), [current[key] for key in average], 1 - decay)


def smoothed(before: tuple[float, ...] | None, now: tuple[float, ...], keep: float) -> tuple[float, ...]:
    """Running means of what is logged; the first values themselves where there was nothing before."""
    return now if before is None else tuple(keep * b + (1 - keep) * n for b, n in zip(before, now, strict=True))
