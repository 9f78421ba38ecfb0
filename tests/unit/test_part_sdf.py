from __future__ import annotations

import torch

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.part_sdf import PartField

SMALL = FieldConfig(levels=4, base_resolution=4, finest_resolution=20, log2_table=10)


def sphere(points: torch.Tensor) -> torch.Tensor:
    return 0.4 - points.norm(dim=1)


def points(count: int = 200) -> torch.Tensor:
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 1


def train(field: PartField, steps: int) -> None:
    """Pulls the field towards a smaller sphere, which moves all parameters."""
    optimiser = torch.optim.AdamW(field.parameters(), lr=1e-2)
    for _ in range(steps):
        values = field.evaluate(points(), sphere(points()))
        loss = ((values.sdf - sphere(points()) + 0.1) ** 2).mean() + ((values.offset - 0.5) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def test_the_field_starts_exactly_as_the_regions_without_offsets():
    values = PartField(SMALL).evaluate(points(), sphere(points()))
    assert torch.equal(values.sdf, sphere(points()))
    assert torch.equal(values.offset, torch.zeros(200, 3))


def test_the_start_is_no_dead_end_gradients_reach_every_parameter_after_one_step():
    field = PartField(SMALL)
    train(field, 1)
    assert field.mlp.weight_out.grad.abs().sum() > 0
    train(field, 1)
    assert all(parameter.grad.abs().sum() > 0 for parameter in field.parameters())


def test_it_learns():
    field = PartField(SMALL)
    train(field, 150)
    residual = field.evaluate(points(), sphere(points())).sdf - sphere(points())
    assert (residual + 0.1).abs().mean() < 0.02


def test_sites_equal_point_by_point_evaluation_values_and_gradients():
    field, grid = PartField(SMALL), TetGrid(16)
    train(field, 20)
    index = (sphere(grid.vertices) > -0.2).nonzero()[:, 0]
    sites = field.sites(grid.axis, index)
    initial = sphere(grid.positions(sites.index))
    features = field.site_features(sites)
    plain = field.evaluate(grid.positions(sites.index), initial)
    assert (field.site_sdf(features, torch.arange(len(sites)), initial) - plain.sdf).abs().max() < 1e-6

    chosen = torch.arange(5, len(sites), 7)
    fast = field.site_values(sites, features, chosen, initial[chosen])
    assert (fast.sdf - plain.sdf[chosen]).abs().max() < 1e-6
    assert (fast.offset - plain.offset[chosen]).abs().max() < 1e-6
    gradients = []
    for values in (fast, type(plain)(plain.sdf[chosen], plain.offset[chosen])):
        field.zero_grad()
        (values.sdf.square().sum() + values.offset.sum()).backward()
        gradients.append([parameter.grad.clone() for parameter in field.parameters()])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


def test_offsets_stay_below_one_and_can_be_switched_off():
    field = PartField(SMALL)
    train(field, 30)
    assert 0 < field.evaluate(points(), sphere(points())).offset.abs().max() < 1
    field = PartField(SMALL.model_copy(update={"offsets": False}))
    train(field, 3)
    assert field.evaluate(points(), sphere(points())).offset.abs().max() == 0


def test_the_state_restores_the_field_and_the_seed_decides_it():
    field = PartField(SMALL, seed=5)
    train(field, 5)
    copy = PartField(SMALL, seed=6)
    copy.load_state_dict(field.state_dict())
    assert all(type(value) is torch.Tensor for value in field.state_dict().values())
    assert torch.equal(copy.evaluate(points(), sphere(points())).sdf, field.evaluate(points(), sphere(points())).sdf)
    assert torch.equal(PartField(SMALL, seed=5).mlp.weight_in, PartField(SMALL, seed=5).mlp.weight_in)
    assert not torch.equal(PartField(SMALL, seed=5).mlp.weight_in, PartField(SMALL, seed=6).mlp.weight_in)
