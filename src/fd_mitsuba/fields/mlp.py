"""A two-layer perceptron over columns: features in rows, points in columns, which is how the lattice delivers them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

_PIECE = 4096
"""Columns at once, so that what lies between the layers stays in the processor's cache."""


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
        """The outputs (width_out, N) of input columns (width_in, N). Gradients flow to weights and inputs, once."""
        return _Perceptron.apply(columns, self.weight_in, self.weight_out)

    @torch.no_grad()
    def first_output(self, columns: Tensor) -> Tensor:
        """Row 0 of the output, (N,), of input columns (width_in, N), without gradients."""
        return (self.weight_out[:1] @ torch.relu_(self.weight_in @ columns))[0]


class _Perceptron(torch.autograd.Function):
    """Piece by piece, and the hidden layer again in the backward pass: faster than to write it down and read it."""

    @staticmethod
    def forward(ctx: Any, columns: Tensor, weight_in: Tensor, weight_out: Tensor) -> Tensor:
        ctx.save_for_backward(columns, weight_in, weight_out)
        pieces = [weight_out @ torch.relu_(weight_in @ piece) for piece in columns.split(_PIECE, dim=1)]
        return torch.cat(pieces, dim=1)

    # What `once_differentiable` makes of it takes no keywords, which torch's own signature has.
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, gradient: Tensor
    ) -> tuple[Tensor | None, ...]:
        columns, weight_in, weight_out = ctx.saved_tensors
        of_columns = torch.empty_like(columns) if ctx.needs_input_grad[0] else None
        of_weight_in, of_weight_out = torch.zeros_like(weight_in), torch.zeros_like(weight_out)
        for begin in range(0, columns.shape[1], _PIECE):
            piece, of_output = columns[:, begin : begin + _PIECE], gradient[:, begin : begin + _PIECE]
            hidden = torch.relu_(weight_in @ piece)
            of_weight_out.addmm_(of_output, hidden.t())
            of_hidden = torch.ops.aten.threshold_backward(weight_out.t() @ of_output, hidden, 0)
            of_weight_in.addmm_(of_hidden, piece.t())
            if of_columns is not None:
                of_columns[:, begin : begin + _PIECE] = weight_in.t() @ of_hidden
        return of_columns, of_weight_in, of_weight_out
