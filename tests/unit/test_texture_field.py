from __future__ import annotations

import math

import pytest
import torch

from fd_mitsuba.config.sections import TextureConfig
from fd_mitsuba.fields.free_points import features_at
from fd_mitsuba.fields.hash_grid import HashGrid
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.scene.bsdf_reading import PlainMaterial

SMALL = TextureConfig(levels=4, base_resolution=4, finest_resolution=32, log2_table=10, hidden=8)


def points(count: int = 200, extent: float = 1.0, seed: int = 0) -> torch.Tensor:
    return extent * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 1)


def shaken(field: TextureField, strength: float = 3.0) -> TextureField:
    """The field with large random weights, so that its values spread over their ranges."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(strength * torch.randn(parameter.shape, generator=generator))
    return field


def test_free_points_equal_the_plain_grid_beyond_the_cube_too():
    grid = HashGrid(5, 2, 3, 40, 9, seed=1).double()
    where = points(300, extent=1.3).double()
    weights = torch.randn(grid.width, 300, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    plain = grid(where).t()
    (plain * weights).sum().backward()
    expected, grid.table.grad = grid.table.grad.clone(), None
    fast = features_at(grid, where)
    (fast * weights).sum().backward()
    assert (fast - plain).abs().max() < 1e-14
    assert (grid.table.grad - expected).abs().max() < 1e-12


def test_free_points_pass_gradcheck_and_take_no_points():
    grid = HashGrid(2, 2, 1, 3, 5, seed=0).double()
    where = points(4).double()
    assert torch.autograd.gradcheck(lambda _: features_at(grid, where), (grid.table,))
    assert features_at(grid, points(0).double()).shape == (4, 0)


def test_starts_as_the_given_material_everywhere_with_an_unbent_normal():
    start = PlainMaterial((0.8, 0.78, 0.74), 0.6, 0.3)
    values = TextureField(TextureConfig(), 0, start)(points())
    assert torch.allclose(values.base_color, torch.tensor([0.8, 0.78, 0.74]).expand(200, 3), atol=1e-6)
    assert torch.allclose(values.roughness, torch.full((200, 1), 0.6), atol=1e-6)
    assert torch.allclose(values.metallic, torch.full((200, 1), 0.3), atol=1e-6)
    assert torch.equal(values.normal, torch.tensor([0.0, 0.0, 1.0]).expand(200, 3))
    assert values.style().shape == (200, 5)


def test_a_start_at_the_end_of_a_range_is_near_it_and_can_still_move():
    field = TextureField(SMALL, 0, PlainMaterial((0.0, 1.0, 0.5), 1.0, 0.0))
    values = field(points())
    assert values.metallic.max() < 0.04 and values.roughness.min() > 0.96 and values.base_color[:, 0].max() < 0.06
    values.metallic.sum().backward()
    assert field.mlp.weight_out.grad[4].abs().max() > 0


@pytest.mark.parametrize("tilt", [0.0, 10.0, 30.0, 80.0])
def test_any_weights_stay_in_the_ranges_and_the_normal_within_its_tilt(tilt):
    config = SMALL.model_copy(
        update={"base_color_range": (0.1, 0.4), "roughness_range": (0.3, 0.3), "max_tilt_deg": tilt}
    )
    values = shaken(TextureField(config), 10)(points(2000))
    assert 0.1 <= values.base_color.min() < 0.11 and 0.39 < values.base_color.max() <= 0.4
    assert torch.equal(values.roughness, torch.full((2000, 1), 0.3))
    assert 0 <= values.metallic.min() < 0.01 and 0.99 < values.metallic.max() <= 1
    assert torch.allclose(values.normal.norm(dim=1), torch.ones(2000), atol=1e-6)
    angles = torch.rad2deg(torch.atan2(values.normal[:, :2].norm(dim=1), values.normal[:, 2]))
    assert angles.max() <= tilt + 1e-3 and (tilt == 0 or angles.max() > 0.9 * tilt)


def test_channels_that_are_not_learned_are_constant_and_pass_no_gradient():
    start = PlainMaterial((1.0, 0.0, 0.2), 0.0, 1.0)
    field = shaken(TextureField(SMALL, 0, start, learned=["roughness"]))
    values = field(points())
    assert torch.equal(values.base_color, torch.tensor([1.0, 0.0, 0.2]).expand(200, 3))
    assert torch.equal(values.metallic, torch.ones(200, 1)) and not values.metallic.requires_grad
    assert torch.equal(values.normal, torch.tensor([0.0, 0.0, 1.0]).expand(200, 3))
    values.roughness.sum().backward()
    used = field.mlp.weight_out.grad.abs().sum(dim=1) > 0
    assert used.tolist() == [False, False, False, True, False, False, False]


def test_gradients_through_the_weights_agree_with_finite_differences():
    field = shaken(TextureField(SMALL, 0).double(), 0.5)
    where = points(50).double()
    weights = torch.randn(50, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss() -> torch.Tensor:
        values = field(where)
        return (torch.cat([values.style(), values.normal], dim=1) * weights).sum()

    loss().backward()
    generator = torch.Generator().manual_seed(2)
    for parameter in field.parameters():
        direction = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        step = 1e-6
        with torch.no_grad():
            parameter.add_(step * direction)
            above = loss().item()
            parameter.sub_(2 * step * direction)
            below = loss().item()
            parameter.add_(step * direction)
        assert (parameter.grad * direction).sum().item() == pytest.approx((above - below) / (2 * step), rel=1e-5)


def test_learns_a_colour_and_a_normal_that_vary_in_space():
    config = SMALL.model_copy(update={"hidden": 32})
    field = TextureField(config, seed=0)
    optimiser = torch.optim.AdamW(field.parameters(), lr=1e-2, betas=(0.9, 0.99), eps=1e-15)
    where = points(400)
    colour = 0.5 + 0.3 * torch.sin(3 * where)
    bend = 0.2 * torch.cos(3 * where[:, :1])
    for _ in range(100):
        optimiser.zero_grad()
        values = field(where)
        loss = (values.base_color - colour).square().mean() + (values.normal[:, :1] - bend).square().mean()
        loss.backward()
        optimiser.step()
    assert math.sqrt(loss.item()) < 0.05


def test_a_moved_field_computes_where_its_weights_are():
    """`meta` stands for a card: tensors there have no values, so that the way back is what fails."""
    moved = TextureField(SMALL).to("meta")
    assert {value.device.type for value in vars(moved(points().to("meta"))).values()} == {"meta"}
    with pytest.raises(NotImplementedError, match="Cannot copy out of meta"):
        moved(points())


def test_the_seed_decides_and_the_global_state_is_left_alone():
    before = torch.random.get_rng_state()
    first, again, other = (TextureField(SMALL, seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["grid.table"], other["grid.table"])
    assert torch.equal(before, torch.random.get_rng_state())
    assert set(first) == {"grid.table", "mlp.weight_in", "mlp.weight_out"}


def test_unknown_channel_is_refused():
    with pytest.raises(ValueError, match="gloss"):
        TextureField(SMALL, learned=["gloss"])
