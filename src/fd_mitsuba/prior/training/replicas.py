"""One training step on several cores: each takes a share of the batch with its own copy of the gradients.

A small network's convolutions are too small to be split among threads; whole samples are not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch

from fd_mitsuba.backend.threads import lone_threads


class Replicas:
    """Modules that share their weights and differ in their gradients, one of them for each thread.

    The first are the given ones: their gradients hold the sum of all after `backward`. The weights may be changed in
    place only, as optimisers do.

    Args:
        modules: what is trained.
        count: how many threads; with 1 the given modules work in the caller's own thread.
    """

    def __init__(self, modules: torch.nn.ModuleDict, count: int) -> None:
        self._modules = [modules, *(_sharing_weights(modules) for _ in range(count - 1))]
        self._threads = lone_threads(count)

    def backward(self, part: Callable[[torch.nn.ModuleDict, slice], tuple[torch.Tensor, Any]], size: int) -> list[Any]:
        """Accumulate the gradient of the mean over a batch of `size` samples.

        Args:
            part: (modules, samples) -> mean loss of these samples, and anything else about them.

        Returns:
            What `part` has said besides, in the samples' order.
        """
        count = len(self._modules)
        bounds = [size * k // count for k in range(count + 1)]

        def work(k: int) -> Any:
            samples = slice(bounds[k], bounds[k + 1])
            loss, rest = part(self._modules[k], samples)
            (loss * ((samples.stop - samples.start) / size)).backward()
            return rest

        if count == 1:
            return [work(0)]
        found = list(self._threads.map(work, range(count)))
        for parameters in zip(*(modules.parameters() for modules in self._modules), strict=True):
            _gather(*parameters)
        return found


def _sharing_weights(modules: torch.nn.ModuleDict) -> torch.nn.ModuleDict:
    made = copy.deepcopy(modules)
    for ours, theirs in zip(made.parameters(), modules.parameters(), strict=True):
        ours.data = theirs.data
    return made


def _gather(first: torch.Tensor, *others: torch.Tensor) -> None:
    """Add the gradients of the others to the first's, and forget them."""
    for other in others:
        if other.grad is not None:
            first.grad = other.grad if first.grad is None else first.grad.add_(other.grad)
            other.grad = None
