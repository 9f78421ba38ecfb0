from __future__ import annotations

import math

import pytest
import torch

from fd_mitsuba.losses.collision import loss_collision
from fd_mitsuba.losses.focal import loss_focal
from fd_mitsuba.losses.presence import loss_presence


def test_focal_by_hand():
    value = loss_focal(torch.tensor([0.02]), torch.tensor([0.3]), 0.05, 0.01, margin=0.005)
    assert value.item() == pytest.approx((1 - math.exp(-0.09 / 0.05)) * math.tanh(2.5), rel=1e-6)


def test_focal_is_zero_in_the_region_and_outside_the_part():
    sdf, distance = torch.tensor([0.5, -0.1]), torch.tensor([0.0, 0.4])
    assert loss_focal(sdf, distance, 0.05, 0.01).item() == 0
    assert loss_focal(sdf, distance, 0.05, 0.01, margin=0.2).item() > 0


def test_focal_grows_with_distance_and_with_depth_in_the_part():
    near, far = (loss_focal(torch.tensor([0.01]), torch.tensor([d]), 0.05, 0.01) for d in (0.1, 0.2))
    shallow, deep = (loss_focal(torch.tensor([s]), torch.tensor([0.1]), 0.05, 0.01) for s in (0.005, 0.02))
    assert near < far and shallow < deep


def test_focal_pushes_the_part_away_from_where_it_must_not_be():
    sdf = torch.tensor([0.01, 0.01], requires_grad=True)
    loss_focal(sdf, torch.tensor([0.3, 0.0]), 0.05, 0.01).backward()
    assert sdf.grad[0] > 0 and sdf.grad[1] == 0


def test_collision_by_hand_and_zero_where_only_one_is_inside():
    base, part = torch.tensor([0.2, 0.2, -0.2, -0.2]), torch.tensor([0.3, -0.3, 0.3, -0.3])
    assert loss_collision(base, part).item() == pytest.approx(0.06 / 4)


def test_gradients_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    sdf = (0.1 * torch.randn(30, generator=generator, dtype=torch.float64)).requires_grad_()
    other = (0.1 * torch.randn(30, generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: loss_focal(s, other.detach().abs(), 0.05, 0.01, 0.02), (sdf,))
    assert torch.autograd.gradcheck(loss_collision, (other, sdf))


def test_no_samples_cost_nothing_and_give_finite_gradients():
    nothing = torch.empty(0, requires_grad=True)
    total = loss_focal(nothing, torch.empty(0), 0.05, 0.01) + loss_collision(torch.empty(0), nothing)
    total.backward()
    assert total.item() == 0


def test_presence_by_hand():
    sdf = torch.tensor([-0.3, -0.1, -0.2, 0.5, -0.4, 0.3])
    members = torch.tensor([[1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1], [0, 0, 0, 0, 0, 0]], dtype=torch.bool)
    # First region: its two highest are -0.1 and -0.2; second: 0.5 and 0.3, deep enough; third: without points.
    assert loss_presence(sdf, members, 0.5, 0.02).item() == pytest.approx((0.02 + 0.15) / 2)
    assert loss_presence(sdf, members[2:], 0.5, 0.02).item() == 0
    assert loss_presence(torch.zeros(6), members[2:], 0.5, 0.02).item() == 0


def test_presence_lifts_the_deepest_points_of_an_empty_region_and_nothing_else():
    sdf = torch.tensor([-0.3, -0.1, -0.2, -0.05], requires_grad=True)
    members = torch.tensor([[True, True, True, False]])
    loss_presence(sdf, members, 0.5, 0.01).backward()
    assert sdf.grad.tolist() == pytest.approx([0, -0.5, -0.5, 0])
