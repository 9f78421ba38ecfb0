from __future__ import annotations

import pytest
import torch
from torch import nn

from fd_mitsuba.training.weight_average import WeightAverage


def weight(value: float) -> nn.Linear:
    module = nn.Linear(1, 1, bias=False).double()
    with torch.no_grad():
        module.weight.fill_(value)
    return module


def test_the_average_is_the_weighted_sum_that_its_factors_say() -> None:
    values = [3.0, -1.0, 4.0, 1.0, -5.0, 9.0]
    average = WeightAverage(weight(2.0), 0.4)
    for step, value in enumerate(values):
        average.update(weight(value), step)
    factors = [min(0.4, (1 + step) / (10 + step)) for step in range(len(values))]
    shares = [1.0]
    for factor in factors:
        shares = [share * factor for share in shares] + [1 - factor]
    assert sum(shares) == pytest.approx(1, abs=1e-15)
    expected = sum(share * value for share, value in zip(shares, [2.0, *values], strict=True))
    assert float(average.module.weight) == pytest.approx(expected, abs=1e-14)


def test_what_does_not_move_is_its_own_average_and_what_shakes_is_stilled() -> None:
    still, shaken = WeightAverage(weight(0.7), 0.98), WeightAverage(weight(0.0), 0.98)
    for step in range(600):
        still.update(weight(0.7), step)
        shaken.update(weight(float(step % 2)), step)
    assert float(still.module.weight) == pytest.approx(0.7, abs=1e-14)
    assert float(shaken.module.weight) == pytest.approx(0.5, abs=0.006)


def test_the_learned_module_is_left_alone() -> None:
    module = weight(1.0)
    average = WeightAverage(module, 0.5)
    average.update(weight(3.0), 100)
    assert module.weight.requires_grad and not average.module.weight.requires_grad
    assert module.weight.item() == 1.0 < average.module.weight.item()


@pytest.mark.parametrize("factor", [-0.1, 1.0, 1.5])
def test_factors_without_sense_are_refused(factor: float) -> None:
    with pytest.raises(ValueError, match="below 1"):
        WeightAverage(weight(0.0), factor)
