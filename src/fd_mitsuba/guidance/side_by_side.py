"""A network's samples on several cores at once.

The convolutions of a small network are too small to be split among threads: with two of them, which sleep between the
operations, a pass of the built-in prior took nearly twice as long as with one. Whole samples can be shared out. Large
networks are left as they are: each thread would read all the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import torch
from torch import Tensor, nn

from fd_mitsuba.backend.threads import lone_threads

_SMALL = 100_000_000
"""Weights of a network below which its samples are shared out."""


def cores_for_samples(network: nn.Module, device: torch.device) -> int:
    """How many threads should work on samples of their own: torch's own number, or 1."""
    if device.type != "cpu" or sum(weight.numel() for weight in network.parameters()) >= _SMALL:
        return 1
    return torch.get_num_threads()


def of_samples(
    call: Callable[..., Tensor], inputs: Sequence[Tensor], most: int, cores: int, together: int = 1
) -> Tensor:
    """`call` of the rows of all inputs, joined: (N, ...).

    Args:
        call: takes some rows of each input; gradients flow as they would without threads.
        inputs: tensors of N rows.
        most: rows at once, in all threads together.
        cores: threads that each work alone; 1: the caller's, with whatever torch gives it.
        together: so many consecutive rows are never parted; divides N, and is at most `most`.
    """
    count, most = len(inputs[0]) // together, most // together
    workers = max(1, min(cores, count, most))
    rows = together * min(most // workers, -(-count // workers))
    pieces = list(zip(*(whole.split(rows) for whole in inputs), strict=True))
    if cores == 1:
        return torch.cat([call(*piece) for piece in pieces])
    with_gradient = torch.is_grad_enabled()  # which every thread decides for itself

    def work(piece: tuple[Tensor, ...]) -> Tensor:
        with torch.set_grad_enabled(with_gradient):
            return call(*piece)

    return torch.cat(list(_threads(workers).map(work, pieces)))


_threads = cache(lone_threads)
"""By their number: the same ones serve all calls."""
