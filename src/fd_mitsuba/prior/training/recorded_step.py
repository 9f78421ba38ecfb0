"""A training step on a card as one launch: a small network's many kernels take longer to launch than to run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

_WARM_UP = 3


class RecordedStep:
    """A function of tensors on a card, recorded as a CUDA graph for each set of shapes and replayed from then on.

    The function must launch the same kernels at every call and not wait for the card; what it returns is overwritten
    by the next call. Its first calls run as they are, since libraries set themselves up in them.

    Args:
        function: tensors -> tensors; may change others in place, such as weights.
        generator: what it draws random numbers from, on the card.

    Example:
        >>> step = RecordedStep(train_on_batch, generator)  # doctest: +SKIP
        >>> losses = step(base, edited)  # doctest: +SKIP
    """

    def __init__(self, function: Callable[..., Any], generator: torch.Generator) -> None:
        self._function, self._generator = function, generator
        self._calls: dict[tuple, int] = {}
        self._recorded: dict[tuple, tuple[torch.cuda.CUDAGraph, tuple[torch.Tensor, ...], Any]] = {}

    def __call__(self, *inputs: torch.Tensor) -> Any:
        shapes = tuple(values.shape for values in inputs)
        if shapes not in self._recorded:
            calls = self._calls[shapes] = self._calls.get(shapes, 0) + 1
            if calls <= _WARM_UP:
                return self._aside(inputs)
            self._record(shapes, inputs)
        graph, own_inputs, outputs = self._recorded[shapes]
        for own, given in zip(own_inputs, inputs, strict=True):
            own.copy_(given, non_blocking=True)
        graph.replay()
        return outputs

    def _aside(self, inputs: tuple[torch.Tensor, ...]) -> Any:
        """On a stream of its own, as recording will be: autograd remembers the stream of a weight's first use."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            outputs = self._function(*inputs)
        torch.cuda.current_stream().wait_stream(stream)
        return outputs

    def _record(self, shapes: tuple, inputs: tuple[torch.Tensor, ...]) -> None:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        own_inputs = tuple(values.clone() for values in inputs)
        torch.cuda.synchronize()
        with torch.cuda.graph(graph):
            outputs = self._function(*own_inputs)
        self._recorded[shapes] = graph, own_inputs, outputs
