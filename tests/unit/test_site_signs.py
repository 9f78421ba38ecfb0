from __future__ import annotations

import math
from itertools import count

import pytest
import torch

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.extraction.site_signs import SiteSigns
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.change_bound import ChangeBound
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.fields.union import soft_union

SMALL = FieldConfig(levels=4, base_resolution=4, finest_resolution=20, log2_table=10)
GRID = TetGrid(24)
BASE = 0.5 - (GRID.vertices - torch.tensor([0.0, -0.5, 0.0])).norm(dim=1)
REGION = 0.35 - (GRID.vertices - torch.tensor([0.1, 0.2, 0.0])).norm(dim=1)
DEPTH = 0.02


def descent(field: PartField, rate: float = 1e-3):
    """Steps towards one wavy shape after another."""
    optimiser = torch.optim.AdamW(field.parameters(), lr=rate)
    generator = torch.Generator().manual_seed(3)
    points = 2 * torch.rand(400, 3, generator=generator) - 1
    for step in count():
        phase = torch.tensor([step // 15, 2 * step // 15, 0.0])
        target = 0.1 * torch.sin(4 * points + phase).sum(dim=1)
        values = field.evaluate(points, torch.zeros(400))
        optimiser.zero_grad()
        ((values.sdf - target) ** 2).sum().backward()
        optimiser.step()
        yield


def signs_and_truth(field: PartField, k: float, only_outside: bool, depth: float | None = DEPTH):
    """The keeper of signs, and what it must say, from all sites."""
    index = (REGION > -0.15).nonzero()[:, 0]
    sites = field.sites(GRID.axis, index)
    base, region, every = BASE[sites.index], REGION[sites.index], torch.arange(len(sites))

    def truth(field: PartField) -> tuple[torch.Tensor, torch.Tensor]:
        part = field.site_sdf(field.site_features(sites), every, region)
        return soft_union(base, part, k, only_outside) > 0, part > DEPTH

    return sites, SiteSigns(base, region, k, only_outside, depth), truth


@pytest.mark.parametrize(("k", "only_outside"), [(0.15, False), (0.0, False), (0.15, True)])
def test_signs_are_those_of_all_sites_though_few_are_looked_at(k, only_outside):
    field = PartField(SMALL)
    sites, signs, truth = signs_and_truth(field, k, only_outside)
    looked_at, flips, before = [], 0, None
    for _, _ in zip(range(60), descent(field), strict=False):
        looked_at.append(len(signs.update(field, field.site_features(sites))))
        inside, deeper = truth(field)
        assert torch.equal(signs.inside, inside) and torch.equal(signs.deeper, deeper)
        flips += 0 if before is None else int((inside != before).sum())
        before = inside
    assert looked_at[0] == len(sites) and max(looked_at[1:]) < 0.5 * len(sites)
    assert flips > 50


def test_a_leap_another_field_and_values_that_are_no_numbers_are_followed():
    field, other = PartField(SMALL), PartField(SMALL, seed=9)
    next(descent(other, 0.3))
    sites, signs, truth = signs_and_truth(field, 0.15, False)
    broken = PartField(SMALL)
    broken.load_state_dict(other.state_dict())
    broken.grid.table.data[:] = math.nan
    for state in (field, other, broken, field, field, other):
        signs.update(state, state.site_features(sites))
        assert all(torch.equal(one, two) for one, two in zip((signs.inside, signs.deeper), truth(state), strict=True))


def test_nobody_looks_at_the_depth_unless_asked():
    field = PartField(SMALL)
    sites, signs, truth = signs_and_truth(field, 0.15, False, None)
    signs.update(field, field.site_features(sites))
    assert torch.equal(signs.inside, truth(field)[0]) and not signs.deeper.any()


def test_the_bound_holds_and_is_not_idle():
    field, bound = PartField(SMALL), ChangeBound()
    assert bound.since_last(field) == math.inf
    points = 2 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) - 1
    steps, last = descent(field, 1e-2), field.evaluate(points, torch.zeros(4000)).sdf.detach()
    for _ in range(30):
        next(steps)
        sdf = field.evaluate(points, torch.zeros(4000)).sdf.detach()
        moved, most = float((sdf - last).abs().max()), bound.since_last(field)
        assert 0 < moved <= most < 60 * moved
        last = sdf
    assert bound.since_last(field) == 0


def test_a_site_s_value_has_the_same_bits_whoever_else_is_asked_for():
    field = PartField()
    for _, _ in zip(range(5), descent(field, 1e-2), strict=False):
        pass
    sites, _, _ = signs_and_truth(field, 0.15, False)
    features, region = field.site_features(sites), REGION[sites.index]
    whole = field.site_sdf(features, torch.arange(len(sites)), region)
    for seed in range(20):
        chance = torch.rand(len(sites), generator=torch.Generator().manual_seed(seed))
        some = (chance < 0.01 + 0.03 * seed).nonzero()[:, 0]
        assert torch.equal(field.site_sdf(features, some, region[some]), whole[some])
