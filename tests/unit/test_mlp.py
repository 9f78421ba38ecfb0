"""The perceptron over columns, which works piece by piece, against the two products that it stands for."""

from __future__ import annotations

import pytest
import torch

from fd_mitsuba.fields import mlp as module
from fd_mitsuba.fields.mlp import ColumnMlp


def perceptron(columns: int) -> tuple[ColumnMlp, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    net = ColumnMlp(5, 7, 2, seed=1).double()
    with torch.no_grad():
        net.weight_out.copy_(torch.randn(2, 7, generator=generator))
    return net, torch.randn(5, columns, generator=generator, dtype=torch.float64).requires_grad_()


@pytest.mark.parametrize("columns", [0, 3, 4, 11])
def test_equals_the_two_products_and_their_gradients_whatever_the_pieces(monkeypatch, columns):
    monkeypatch.setattr(module, "_PIECE", 4)
    net, inputs = perceptron(columns)
    plain = net.weight_out @ torch.relu(net.weight_in @ inputs)
    weights = torch.randn(2, columns, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = torch.autograd.grad((plain * weights).sum(), (inputs, net.weight_in, net.weight_out))
    found = torch.autograd.grad((net(inputs) * weights).sum(), (inputs, net.weight_in, net.weight_out))
    torch.testing.assert_close(net(inputs), plain)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)


def test_gradients_equal_finite_differences(monkeypatch):
    monkeypatch.setattr(module, "_PIECE", 2)
    net, inputs = perceptron(5)
    assert torch.autograd.gradcheck(module._Perceptron.apply, (inputs, net.weight_in, net.weight_out))
