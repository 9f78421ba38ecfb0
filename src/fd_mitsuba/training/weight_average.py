"""A running average of a field's weights: what single steps shake is not in it."""

from __future__ import annotations

import copy
from typing import Generic, TypeVar

import torch
from torch import nn

Module = TypeVar("Module", bound=nn.Module)


class WeightAverage(Generic[Module]):
    """The exponential average of a module's parameters over the steps of a run.

        average <- f average + (1 - f) parameters,    f = min(factor, (1 + step) / (10 + step))

    so that a run of few steps, or the start of a long one, is not held back by what it started from.

    Args:
        module: whose parameters; they are copied.
        factor: in [0, 1); the last 1 / (1 - factor) steps or so count.

    Attributes:
        module: a copy with the averaged parameters, without gradients.

    Example:
        A parameter that alternates between 0 and 1 has an average near 0.5 after many steps with a factor of 0.98.
    """

    def __init__(self, module: Module, factor: float) -> None:
        if not 0 <= factor < 1:
            raise ValueError(f"factor = {factor}: give one of at least 0 and below 1")
        self.module: Module = copy.deepcopy(module).requires_grad_(False)
        self._factor = factor

    @torch.no_grad()
    def update(self, module: nn.Module, step: int) -> None:
        """Take the parameters after step `step`, counted from 0."""
        share = 1 - min(self._factor, (1 + step) / (10 + step))
        for average, parameter in zip(self.module.parameters(), module.parameters(), strict=True):
            average.lerp_(parameter, share)
