"""The curve from linear light to sRGB, against its definition and torch's own differentiation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fd_mitsuba.render.tonemap import KNEE, auto_exposure, to_linear, to_srgb


def test_below_the_knee_it_is_the_srgb_curve() -> None:
    linear = np.linspace(0, KNEE, 200)
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(to_srgb(torch.tensor(linear)).numpy() - expected).max() < 1e-6
    assert np.abs(to_linear(torch.tensor(expected)).numpy() - linear).max() < 1e-6


def test_it_rises_everywhere_and_stays_below_one() -> None:
    linear = torch.tensor([0.0, 1e-6, 0.003, 0.5, KNEE, KNEE + 1e-4, 1.0, 5.0, 1000.0], dtype=torch.float64)
    linear.requires_grad_()
    values = to_srgb(linear)
    values.sum().backward()
    assert (values.diff() > 0).all() and values.max() < 1
    assert torch.isfinite(linear.grad).all() and (linear.grad > 0).all()
    assert torch.autograd.gradcheck(to_srgb, torch.tensor([0.001, 0.2, 0.79, 0.81, 3.0]).double().requires_grad_())


def test_exposure_brings_the_bright_part_of_the_base_to_its_level() -> None:
    mask = torch.zeros(2, 1, 10, 10)
    mask[:, :, :5] = 1.0
    mask[:, :, 5] = 0.25  # too little of the base to count
    base = mask * torch.rand(2, 3, 10, 10, generator=torch.Generator().manual_seed(0)) * 40
    factor = auto_exposure(base, mask)
    luminance = (base * torch.tensor([0.2126, 0.7152, 0.0722]).view(1, 3, 1, 1)).sum(1, keepdim=True)[mask > 0.5]
    assert float(luminance.quantile(0.95)) * factor == pytest.approx(0.8, rel=0.05)


def test_exposure_of_nothing_is_one() -> None:
    assert auto_exposure(torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4)) == 1.0
    assert auto_exposure(torch.zeros(1, 3, 4, 4), torch.ones(1, 1, 4, 4)) == 1.0
