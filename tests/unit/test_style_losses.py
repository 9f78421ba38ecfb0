from __future__ import annotations

import math

import pytest
import torch

from fd_mitsuba.losses.style import jittered, loss_style_boundary, loss_style_gradient


def test_both_by_hand():
    first = torch.tensor([[0.2, 0.5, 0.1], [0.4, 0.0, 1.0]])
    second = torch.tensor([[0.1, 0.7, 0.1], [0.4, 0.3, 0.6]])
    expected = ((0.01 + 0.04) + (0.09 + 0.16)) / 2
    assert loss_style_gradient(first, second).item() == pytest.approx(expected, rel=1e-6)
    assert loss_style_boundary(first, second).item() == pytest.approx(expected, rel=1e-6)


def test_a_constant_material_costs_nothing():
    material = torch.full((7, 5), 0.3)
    assert loss_style_gradient(material, material.clone()).item() == 0
    assert loss_style_boundary(material, material.clone()).item() == 0


def test_a_linear_material_costs_its_squared_gradient_times_the_jitter_variance():
    """E |A (x + d) - A x|^2 = s^2 |A|^2 for d normal with deviation s."""
    matrix = torch.tensor([[0.5, -1.0, 0.2], [0.0, 0.3, 0.7]], dtype=torch.float64)
    points = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = jittered(points, 0.01, torch.Generator().manual_seed(1))
    loss = loss_style_gradient(points @ matrix.T, moved @ matrix.T).item()
    assert loss == pytest.approx(1e-4 * matrix.square().sum().item(), rel=0.02)


def test_the_jitter_is_normal_and_its_seed_decides():
    points = torch.zeros(50_000, 3)
    delta = jittered(points, 0.02, torch.Generator().manual_seed(3))
    assert torch.equal(delta, jittered(points, 0.02, torch.Generator().manual_seed(3)))
    assert jittered(points.half(), 0.02, torch.Generator()).dtype == torch.float16
    assert delta.std().item() == pytest.approx(0.02, rel=0.02) and abs(delta.mean().item()) < 2e-4
    within = (delta.abs() < 0.02).double().mean().item()
    assert within == pytest.approx(math.erf(1 / math.sqrt(2)), abs=0.01)


def test_gradients_agree_with_finite_differences_and_spare_the_base():
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.rand(9, 5, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(loss_style_gradient, (first, second))
    assert torch.autograd.gradcheck(lambda part: loss_style_boundary(part, second.detach()), (first,))
    loss_style_boundary(first, second).backward()
    assert first.grad is not None and second.grad is None


def test_no_points_cost_nothing_and_give_finite_gradients():
    nothing = torch.empty(0, 5, requires_grad=True)
    total = loss_style_gradient(nothing, nothing) + loss_style_boundary(nothing, torch.empty(0, 5))
    total.backward()
    assert total.item() == 0 and nothing.grad is not None
