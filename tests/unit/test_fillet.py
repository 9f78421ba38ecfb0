"""The fillet between base and part against the mean that it is by definition, and its edges against calculus."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from fd_mitsuba.export.final_surface.fillet import fillet, fillet_reach, foot_width, shown_part
from fd_mitsuba.fields.union import soft_union

K = 0.15
UP, OVER = 6 / 7 * K, 12 / 35 * K
"""How wide it is up the part and over the base."""


def added(apart: np.ndarray | float, k: float = K) -> np.ndarray:
    base = torch.as_tensor(np.atleast_1d(apart), dtype=torch.float64)
    return fillet(base - 0.3, torch.full_like(base, -0.3), k).numpy()


@pytest.mark.parametrize("apart", [-0.14, -0.12, -0.05, -0.01, 0.0, 0.02, 0.05, 0.06])
def test_it_is_the_mean_of_shifted_maxima(apart: float) -> None:
    density = stats.beta(5, 2, loc=-UP, scale=UP + OVER)
    mean, _ = integrate.quad(lambda u: max(apart - u, 0) * density.pdf(u), -UP, OVER, points=[apart], epsabs=1e-12)
    assert added(apart) == pytest.approx(mean - max(apart, 0), abs=1e-9)


def test_it_is_nothing_beyond_its_width_and_never_negative() -> None:
    assert (added(np.array([-1.0, -1.01 * UP, 1.01 * OVER, 0.5])) == 0).all()
    assert added(np.linspace(-UP, OVER, 1001)).min() > -1e-12


def test_slope_and_curvature_have_no_jump() -> None:
    apart, step = np.linspace(-1.2 * K, 0.6 * K, 4001), 1.8 * K / 4000
    whole = added(apart) + np.maximum(apart, 0)
    slope = np.diff(whole) / step
    curvature = np.diff(slope) / step
    assert slope.min() > -1e-9 and slope.max() < 1 + 1e-9 and (np.diff(slope) > -1e-9).all(), "convex, as a maximum is"
    # soft_union's slope jumps by 0.6 where both are equal.
    assert np.diff(slope).max() < 0.005 and np.abs(np.diff(curvature)).max() < 0.02 * curvature.max()


def test_it_is_nowhere_higher_than_the_unions() -> None:
    zero = torch.zeros(1, dtype=torch.float64)
    for apart in (-0.5 * K, -0.2 * K, -0.1 * K, 0.0, 0.1 * K, 0.2 * K):
        # The union's is 0.1 k high, with a crease.
        assert 0 < added(apart)[0] < float(soft_union(zero + apart, zero, K)) - max(apart, 0)


def test_what_is_shown_of_a_part_is_the_unions_above_a_film() -> None:
    heights, level = torch.linspace(0.2 * K, 2 * K, 200, dtype=torch.float64), torch.tensor(-0.05 * K).double()
    # Over a flat base, under a part whose field is level: the union is a film as thick as it is positive.
    union = soft_union(-heights, level.expand_as(heights), K)
    shown = shown_part(-heights, level.expand_as(heights), K)
    assert torch.equal(shown > 0, union > 0) and 0.3 * K < float(heights[shown > 0].max()) < 0.4 * K
    assert shown[0] > 0 and shown_part(-1e-6 * heights, level.expand_as(heights), K).min() > 0, "down to the base"
    # A field so low that the union is a film no higher than 0.1 k is no part, at any height.
    thin = torch.full_like(heights, -0.12 * K)
    assert soft_union(-heights / 3, thin, K).max() > 0
    assert shown_part(-heights / 100, thin - 0.02 * K, K).max() < 0


def test_far_from_the_base_and_without_a_fillet_a_part_is_itself() -> None:
    part, base = torch.linspace(-0.3, 0.3, 61), torch.full((61,), -1.0)
    assert torch.equal(shown_part(base, part, K), part) and torch.equal(shown_part(base + 0.99, part, 0.0), part)


@pytest.mark.parametrize("k", [0.05, 0.15, 0.3])
def test_its_reach_is_where_it_is_as_high_as_asked(k: float) -> None:
    film = 0.06 * 2.1 / 64
    away = fillet_reach(k, film)
    # Over a flat base, `film` above it and `away` from the part, the union's value is zero.
    value = max(-film, -away) + float(added(away - film, k)[0])
    assert value == pytest.approx(0.0, abs=1e-7) and film < away < 12 / 35 * k + film


def test_without_a_width_there_is_none() -> None:
    assert fillet_reach(0.0, 0.002) == fillet_reach(0.01, 0.002) == 0.0
    assert (added(np.linspace(-1, 1, 11), 0.0) == 0).all()
    assert foot_width(0.0, 0.03) == 0.0 and foot_width(0.15, 0.03) == pytest.approx(0.009)
