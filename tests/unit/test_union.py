from __future__ import annotations

import pytest
import torch

from fd_mitsuba.fields.union import soft_subtract, soft_union


def pairs(count: int = 500) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return tuple(0.6 * torch.rand(2, count, generator=generator, dtype=torch.float64) - 0.3)


def test_the_papers_formula_by_hand():
    union = soft_union(torch.tensor([0.10]), torch.tensor([0.05]), k=0.15)
    assert union.item() == pytest.approx(0.10 + 0.1 * (0.15 - 0.05) ** 2 / 0.15)


def test_k_zero_is_the_plain_maximum():
    base, part = pairs()
    assert torch.equal(soft_union(base, part, 0), torch.maximum(base, part))


def test_it_is_symmetric_above_the_maximum_and_exact_where_the_two_are_apart():
    base, part = pairs()
    union = soft_union(base, part, 0.15)
    assert torch.equal(union, soft_union(part, base, 0.15))
    excess = union - torch.maximum(base, part)
    apart = (base - part).abs() >= 0.15
    assert (excess >= 0).all() and excess.max() <= 0.1 * 0.15 + 1e-12
    assert (excess[apart] == 0).all() and (excess[~apart] > 0).all()


def test_far_below_the_base_nothing_changes_a_single_bit():
    base = pairs()[0].float()
    assert torch.equal(soft_union(base, torch.full_like(base, -10.0), 0.15), base)


def test_only_outside_blends_only_where_both_are_negative():
    base, part = pairs()
    union, plain = soft_union(base, part, 0.15, only_outside=True), torch.maximum(base, part)
    outside = plain < 0
    assert torch.equal(union[~outside], plain[~outside])
    assert torch.equal(union[outside], soft_union(base, part, 0.15)[outside])
    surface, below = torch.zeros(1), torch.tensor([-0.01])  # neither solid's surface moves
    assert soft_union(surface, below, 0.15, only_outside=True).item() == 0


@pytest.mark.parametrize("only_outside", [False, True])
def test_gradients_agree_with_finite_differences(only_outside):
    base, part = (values.clone().requires_grad_() for values in pairs(40))
    assert torch.autograd.gradcheck(lambda b, e: soft_union(b, e, 0.15, only_outside), (base, part))


def test_the_fillet_sets_in_without_a_kink():
    part = torch.tensor([-0.15 - 1e-6, -0.15 + 1e-6], dtype=torch.float64, requires_grad=True)
    soft_union(torch.zeros(2, dtype=torch.float64), part, 0.15).sum().backward()
    assert (part.grad[1] - part.grad[0]).abs() < 1e-5


def test_soft_subtract_by_hand_and_as_the_union_of_the_outsides() -> None:
    base, part = torch.tensor([0.3, 0.1, 0.02, -0.2, 0.5]), torch.tensor([-0.5, 0.1, -0.04, -0.3, 0.2])
    # h = 0.1 - |base + part| is 0, 0, 0.08, 0, 0: only the third is near the cut's edge.
    expected = torch.tensor([0.3, -0.1, 0.02 - 0.1 * 0.08**2 / 0.1, -0.2, -0.2])
    torch.testing.assert_close(soft_subtract(base, part, 0.1), expected)
    torch.testing.assert_close(soft_subtract(base, part, 0.0), torch.minimum(base, -part))
    torch.testing.assert_close(-soft_subtract(base, part, 0.3), soft_union(-base, part, 0.3))
