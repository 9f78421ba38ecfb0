"""A two-layer perceptron over columns: features in rows, points in columns, which is how the lattice delivers them."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn


class ColumnMlp(nn.Module):
    """`weight_out @ relu(weight_in @ x)`, without biases, starting at exactly zero.

    The outer weights start at zero, so the first output is 0 everywhere while their gradient is not; from the second
    step on gradients reach the inner weights and the features too.

    Args:
        width_in: rows of the input.
        hidden: rows of the hidden layer.
        width_out: rows of the output.
        seed: decides the inner weights, uniform within +-sqrt(6 / width_in) (He).
    """

    def __init__(self, width_in: int, hidden: int, width_out: int, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        start = 2 * torch.rand(hidden, width_in, generator=generator, dtype=torch.float64) - 1
        self.weight_in = nn.Parameter((start * math.sqrt(6 / width_in)).to(torch.get_default_dtype()))
        self.weight_out = nn.Parameter(torch.zeros(width_out, hidden))

    def forward(self, columns: Tensor) -> Tensor:
        """The outputs (width_out, N) of input columns (width_in, N). Gradients flow to weights and inputs."""
        return self.weight_out @ torch.relu(self.weight_in @ columns)

    @torch.no_grad()
    def first_output(self, pieces: Iterable[Tensor]) -> Tensor:
        """Row 0 of the output, (N,), without gradients, of input columns in pieces that fit the processor's cache."""
        outer = self.weight_out[:1]
        outputs = [outer.new_empty(1, 0), *(outer @ torch.relu_(self.weight_in @ piece) for piece in pieces)]
        return torch.cat(outputs, dim=1)[0]
