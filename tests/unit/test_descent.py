"""A step of the optimiser against AdamW as it is written down (Loshchilov and Hutter, algorithm 2)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import RunStopped
from fd_mitsuba.training.descent import adamw, descend, fade

RATE, BETAS, EPS, DECAY = 0.1, (0.6, 0.8), 0.05, 0.2


@pytest.mark.parametrize("stage", ["geometry", "appearance"])
def test_three_steps_are_those_of_the_formula(stage: str) -> None:
    """Rates and decays differ from torch's own, and gradients from step to step, so that each setting tells."""
    settings = {"learning_rate": RATE, "betas": BETAS, "eps": EPS, "weight_decay": DECAY}
    field = torch.nn.Linear(3, 1, bias=False)
    start = np.array([0.5, -1.0, 2.0], np.float32)
    with torch.no_grad():
        field.weight.copy_(torch.from_numpy(start))
    optimiser = adamw(field, getattr(RunConfig.model_validate({stage: settings}), stage))
    slopes = np.array([[1.0, -0.1, 0.02], [-2.0, 0.3, 0.0], [0.5, 0.5, -4.0]], np.float32)
    expected, mean, square = start.astype(np.float64), np.zeros(3), np.zeros(3)
    for step, slope in enumerate(slopes, 1):
        # Two losses whose weighted sum has the gradient `slope`.
        losses = {"one": (field.weight * torch.from_numpy(slope)).sum(), "other": field.weight.sum()}
        values = descend(optimiser, losses, {"one": 1.0, "other": 0.25}, step, "wait")
        gradient = slope + 0.25
        assert values["loss"] == pytest.approx(float(expected @ gradient), rel=1e-5, abs=1e-6)
        assert values["loss_other"] == pytest.approx(float(expected.sum()), rel=1e-5)
        mean = BETAS[0] * mean + (1 - BETAS[0]) * gradient
        square = BETAS[1] * square + (1 - BETAS[1]) * gradient**2
        expected -= RATE * DECAY * expected
        expected -= RATE * (mean / (1 - BETAS[0] ** step)) / (np.sqrt(square / (1 - BETAS[1] ** step)) + EPS)
        np.testing.assert_allclose(field.weight.detach().numpy()[0], expected, rtol=1e-5, atol=1e-6)


def test_a_loss_that_is_no_number_ends_the_run_and_changes_nothing() -> None:
    field = torch.nn.Linear(1, 1, bias=False)
    before = field.weight.detach().clone()
    optimiser = adamw(field, RunConfig().geometry)
    with pytest.raises(RunStopped, match="step 7: .*lower it"):
        descend(optimiser, {"sds": field.weight.sum() * torch.nan}, {"sds": 1.0}, 7, "lower it")
    assert torch.equal(field.weight, before)


@pytest.mark.parametrize("stage", ["geometry", "appearance"])
def test_steps_become_small_at_the_end_and_follow_from_their_number(stage: str) -> None:
    """A constant slope: what Adam then moves by is the step size itself."""
    settings = {"learning_rate": RATE, "weight_decay": 0.0, "steps": 8, "fade": 0.5}
    config = getattr(RunConfig.model_validate({stage: settings}), stage)
    field = torch.nn.Linear(1, 1, bias=False)
    optimiser = adamw(field, config)
    moved = []
    for step in range(8):
        before = float(field.weight.detach())
        fade(optimiser, config, step)
        descend(optimiser, {"one": field.weight.sum()}, {"one": 1.0}, step, "wait")
        moved.append((before - float(field.weight.detach())) / RATE)
    half = np.sqrt(0.5) / 2
    np.testing.assert_allclose(moved, [1, 1, 1, 1, 1, 0.5 + half, 0.5, 0.5 - half], rtol=1e-4)
    fade(optimiser, config, 2)
    assert optimiser.param_groups[0]["lr"] == RATE
    fade(optimiser, config.model_copy(update={"fade": 0.0}), 7)
    assert optimiser.param_groups[0]["lr"] == RATE
