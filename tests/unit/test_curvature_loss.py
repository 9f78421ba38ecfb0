"""What curvature of a surface costs, and where it is looked at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from fd_mitsuba.config import RunConfig
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.losses.curvature import STENCIL, loss_curvature
from fd_mitsuba.training.field_losses import FieldLosses
from fd_mitsuba.training.surface_stencils import SurfaceStencils

SPACING = 0.1
STEPS = torch.tensor(STENCIL, dtype=torch.float64) * SPACING


def cost(sdf: Callable[[Tensor], Tensor], centre: list[float], edge: float = 1e6) -> float:
    points = torch.tensor(centre, dtype=torch.float64) + STEPS
    return float(loss_curvature(sdf(points)[None], SPACING, edge))


@pytest.mark.parametrize("slope", [0.5, 1.0, 3.0])
def test_a_plane_costs_nothing_however_steep_the_field(slope: float) -> None:
    normal = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64), dim=0)
    assert cost(lambda points: slope * points @ normal, [0.3, 0.1, 0.2]) == pytest.approx(0, abs=1e-20)


@pytest.mark.parametrize("slope", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("place", [[0.8, 0.0, 0.0], [0.4, -0.5, 0.45], [0.0, 0.55, 0.6]])
def test_balls_and_bars_cost_their_squared_curvatures(slope: float, place: list[float]) -> None:
    radius = float(np.linalg.norm(place)) / SPACING
    assert cost(lambda points: slope * (0.8 - points.norm(dim=1)), place) == pytest.approx(2 / radius**2, rel=0.02)
    around = float(np.linalg.norm(place[:2])) / SPACING
    if around > 5:
        assert cost(lambda points: slope * points[:, :2].norm(dim=1), place) == pytest.approx(1 / around**2, rel=0.03)


def test_an_edge_costs_no_more_than_its_bound_and_a_dent_less() -> None:
    def box(points: Tensor) -> Tensor:
        return -points.amax(dim=1)

    def dented(points: Tensor) -> Tensor:
        return -points[:, 2] + 0.01 * torch.cos(20 * points[:, 0])

    edge, dent = (cost(shape, [0.0, -0.3, 0.0], edge=0.5) for shape in (box, dented))
    assert 0.7 * 0.25 < edge < 0.25 and 0.02 < dent < 0.5 * edge


def test_gradients_are_those_of_finite_differences() -> None:
    random = torch.Generator().manual_seed(0)
    values = (STEPS @ torch.tensor([0.6, -0.3, 0.7], dtype=torch.float64)).repeat(5, 1)
    values = values + 0.01 * torch.rand(values.shape, generator=random, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda sdf: loss_curvature(sdf, SPACING), [values.requires_grad_()])
    nothing = torch.zeros(0, len(STENCIL), requires_grad=True)
    loss_curvature(nothing, SPACING).backward()
    assert loss_curvature(nothing, SPACING) == 0 and nothing.grad is not None


def ball_stencils(count: int) -> tuple[TetGrid, SurfaceStencils, Tensor, Tensor]:
    """A ball of 0.5 on a grid whose lower half is the base's."""
    grid = TetGrid(20)
    active = GridVertices(torch.arange(grid.count))
    sdf = 0.5 - grid.vertices.norm(dim=1)
    return grid, SurfaceStencils(grid, -grid.vertices[:, 2] - 0.1, active, count), sdf, sdf > 0


def test_stencils_lie_beside_the_surface_that_is_seen() -> None:
    grid, stencils, sdf, part = ball_stencils(10_000)
    found = stencils.find(part, 0).view(-1, len(STENCIL))
    centres = grid.vertices[found[:, STENCIL.index((0, 0, 0))]]
    assert len(found) > 100 and len(found.unique(dim=0)) == len(found)
    depth = sdf[found[:, STENCIL.index((0, 0, 0))]]
    assert (depth > 0).all() and (depth <= grid.spacing + 1e-6).all() and (centres[:, 2] >= -0.1 - 1e-6).all()
    around = grid.vertices[found] - centres[:, None]
    torch.testing.assert_close(around, (torch.tensor(STENCIL) * grid.spacing).expand_as(around), rtol=0, atol=1e-6)
    # A ball of that radius costs what it should, by the grid's own values.
    expected = 2 / (0.5 / grid.spacing) ** 2
    assert float(loss_curvature(sdf[found], grid.spacing, 1e6)) == pytest.approx(expected, rel=0.25)


def test_as_many_stencils_as_asked_for_by_seed() -> None:
    _, stencils, _, part = ball_stencils(7)
    first = stencils.find(part, 1)
    assert len(first) == 7 * len(STENCIL) and torch.equal(first, stencils.find(part, 1))
    assert not torch.equal(first, stencils.find(part, 2))
    assert len(stencils.find(torch.zeros_like(part), 1)) == 0


@pytest.mark.parametrize("also", [[], ["geometry.lambda_tether=1"]])
def test_a_stage_asks_for_stencils_beside_its_samples(also: list[str]) -> None:
    grid, _, sdf, part = ball_stencils(0)
    base = -grid.vertices[:, 2] - 0.1
    config = RunConfig.load(None, ["geometry.lambda_curvature=1", "geometry.focal_samples=50", *also])
    active = GridVertices(torch.nonzero((grid.vertices.abs() < 0.9 * grid.half_extent).all(dim=1))[:, 0])
    losses = FieldLosses(config, grid, base, 1 + sdf[None], active, False)
    asked = losses.ask(3)
    assert asked is not None and callable(asked.samples)
    vertices = asked.samples(part[active])
    drawn, held, beside = asked.split(sdf[vertices])
    assert len(drawn) == 50 and len(held) == 0 and len(beside) > 100
    assert float(losses(sdf[vertices], asked, 3)["curvature"]) == float(loss_curvature(beside, grid.spacing))
    cut = FieldLosses(config, grid, base, 1 + sdf[None], active, True)
    assert "curvature" not in cut.weights
