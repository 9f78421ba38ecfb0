"""What the loop knows of a stage."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from fd_mitsuba.config import RunConfig


class StepRecord(Protocol):
    """What one step reports."""

    values: dict[str, float]
    """Numbers for the metrics file and the progress line."""

    def sheet(self) -> np.ndarray | None:
        """A picture (H, W, 3) uint8 of the step, or None if there is nothing to see."""
        ...


class Stage(Protocol):
    """One stage of a run. Its random numbers depend on (seed, step) only, so that it can go on from any step."""

    name: str
    steps: int
    config: RunConfig
    field: torch.nn.Module
    optimiser: torch.optim.Optimizer
    counters: dict[str, int]
    """What is counted from step to step, such as steps in a row without a visible part; stored with checkpoints."""

    def step(self, step: int) -> StepRecord:
        """Run step `step`, counted from 0, and change the field once; RunStopped if it cannot go on."""
        ...

    def check_field(self, step: int) -> dict[str, float]:
        """Figures of the field as it is; RunStopped if it is of no use any more."""
        ...

    def phase_name(self, step: int) -> str:
        """What the progress line calls this part of the stage."""
        ...
