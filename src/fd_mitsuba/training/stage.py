"""What the loop knows of a stage, and what it tells a caller after each step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from fd_mitsuba.config import RunConfig
from fd_mitsuba.training.weight_average import WeightAverage


@dataclass(frozen=True)
class StepRecord:
    """What one step reports.

    Attributes:
        values: numbers for the metrics file and the progress line.
        sheet: makes a picture (H, W, 3) uint8 of the step, or None if there is nothing to see; called only when a
            contact sheet is due.
    """

    values: dict[str, float]
    sheet: Callable[[], np.ndarray | None]


class Stage(Protocol):
    """One stage of a run. Its random numbers depend on (seed, step) only, so that it can go on from any step."""

    @property
    def name(self) -> str: ...

    @property
    def steps(self) -> int: ...

    @property
    def config(self) -> RunConfig: ...

    @property
    def field(self) -> torch.nn.Module: ...

    @property
    def optimiser(self) -> torch.optim.Optimizer: ...

    @property
    def average(self) -> WeightAverage | None:
        """Of the field over the steps, where there is one: a part of the checkpoints."""
        ...

    @property
    def counters(self) -> dict[str, int]:
        """What is counted from step to step, such as steps in a row without a visible part; stored with checkpoints."""
        ...

    def step(self, step: int) -> StepRecord:
        """Run step `step`, counted from 0, and change the field once; RunStopped if it cannot go on."""
        ...

    def check_field(self, step: int) -> dict[str, float]:
        """Figures of the field as it is; RunStopped if it is of no use any more."""
        ...

    def phase_name(self, step: int) -> str:
        """What the progress line calls this part of the stage."""
        ...


@dataclass(frozen=True)
class StepUpdate:
    """What `on_step` is told after each finished step.

    Attributes:
        stage, phase: names, such as `geometry` and `coarse`.
        step: finished steps, from 1 to `total`.
        values: losses and other numbers, as in `metrics.jsonl`.
        live: the stage itself, to be looked at and not changed: `live.surface()` is the geometry stage's mesh.
    """

    stage: str
    phase: str
    step: int
    total: int
    values: dict[str, float]
    live: Stage


OnStep = Callable[[StepUpdate], None]
"""Called in the training loop: what it raises ends the run, what it takes long for delays the next step."""
