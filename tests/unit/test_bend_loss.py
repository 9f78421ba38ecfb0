from __future__ import annotations

import math

import pytest
import torch

from fd_mitsuba.losses.bend import loss_bend


def tilted(degrees: float, turn: float = 0.4) -> list[float]:
    """A unit normal so many degrees from (0, 0, 1), the direction of its tilt turned about it."""
    angle = math.radians(degrees)
    return [math.sin(angle) * math.cos(turn), math.sin(angle) * math.sin(turn), math.cos(angle)]


def test_the_price_is_the_mean_squared_tangent_of_the_tilt() -> None:
    normals = torch.tensor([tilted(0.0), tilted(30.0), tilted(45.0, turn=2.0)])
    assert loss_bend(normals).item() == pytest.approx((0 + 1 / 3 + 1) / 3, rel=1e-5)


def test_no_points_cost_nothing() -> None:
    nothing = torch.zeros(0, 3, requires_grad=True)
    loss_bend(nothing).backward()
    assert loss_bend(nothing).item() == 0 and nothing.grad.shape == (0, 3)
