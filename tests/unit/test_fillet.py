"""The fillet between base and part against the mean that it is by definition, and its edges against calculus."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from fd_mitsuba.export.final_surface.fillet import fillet, fillet_reach, foot_width
from fd_mitsuba.fields.union import soft_union

K = 0.15


def added(apart: np.ndarray | float, k: float = K) -> np.ndarray:
    base = torch.as_tensor(np.atleast_1d(apart), dtype=torch.float64)
    return fillet(base - 0.3, torch.full_like(base, -0.3), k).numpy()


@pytest.mark.parametrize("apart", [-0.16, -0.12, -0.05, -0.01, 0.0, 0.02, 0.05, 0.07])
def test_it_is_the_mean_of_shifted_maxima(apart: float) -> None:
    density = stats.beta(5, 2, loc=-K, scale=1.4 * K)
    mean, _ = integrate.quad(lambda u: max(apart - u, 0) * density.pdf(u), -K, 0.4 * K, points=[apart], epsabs=1e-12)
    assert added(apart) == pytest.approx(mean - max(apart, 0), abs=1e-9)


def test_it_is_nothing_beyond_its_width_and_never_negative() -> None:
    assert (added(np.array([-1.0, -1.01 * K, 0.41 * K, 0.5])) == 0).all()
    assert added(np.linspace(-K, 0.4 * K, 1001)).min() > -1e-12


def test_slope_and_curvature_have_no_jump() -> None:
    apart, step = np.linspace(-1.2 * K, 0.6 * K, 4001), 1.8 * K / 4000
    whole = added(apart) + np.maximum(apart, 0)
    slope = np.diff(whole) / step
    curvature = np.diff(slope) / step
    assert slope.min() > -1e-9 and slope.max() < 1 + 1e-9 and (np.diff(slope) > -1e-9).all(), "convex, as a maximum is"
    # soft_union's slope jumps by 0.6 where both are equal.
    assert np.diff(slope).max() < 0.005 and np.abs(np.diff(curvature)).max() < 0.02 * curvature.max()


def test_it_is_nearly_as_high_as_the_unions_and_nowhere_higher_up_the_part() -> None:
    zero = torch.zeros(1, dtype=torch.float64)
    assert added(0.0)[0] == pytest.approx(float(soft_union(zero, zero, K)), rel=0.1)
    for apart in (-0.1 * K, -0.2 * K, -0.5 * K):
        assert 0 < added(apart)[0] < float(soft_union(zero + apart, zero, K))


@pytest.mark.parametrize("k", [0.05, 0.15, 0.3])
def test_its_reach_is_where_it_is_as_high_as_asked(k: float) -> None:
    film = 0.06 * 2.1 / 64
    away = fillet_reach(k, film)
    # Over a flat base, `film` above it and `away` from the part, the union's value is zero.
    value = max(-film, -away) + float(added(away - film, k)[0])
    assert value == pytest.approx(0.0, abs=1e-7) and film < away < 0.4 * k + film


def test_without_a_width_there_is_none() -> None:
    assert fillet_reach(0.0, 0.002) == fillet_reach(0.01, 0.002) == 0.0
    assert (added(np.linspace(-1, 1, 11), 0.0) == 0).all()
    assert foot_width(0.0, 0.03) == 0.0 and foot_width(0.15, 0.03) == pytest.approx(0.012)
