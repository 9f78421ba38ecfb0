"""The gradient of a picture through render, marching tetrahedra, union and network, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.extraction.active_vertices import active_vertices
from fd_mitsuba.extraction.surface import SurfaceExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.views import CameraBatch

SIZE = 24
STEP = 0.03


@pytest.fixture(scope="module")
def chain() -> tuple:
    """A ball that grows a part on its top: extractor, field with some shape of its own, cameras, image weights."""
    grid = TetGrid(24)
    points = grid.vertices
    sdf_base = 0.6 - points.norm(dim=1)
    region = 0.35 - (points - torch.tensor([0.05, 0.6, 0.0])).norm(dim=1)
    extractor = SurfaceExtractor(grid, sdf_base, region, active_vertices(grid, region, 0.3))
    field = PartField(FieldConfig(levels=4, finest_resolution=16, log2_table=12), seed=3)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.03 * torch.randn(parameter.shape, generator=generator)
    cameras = CameraBatch.around(np.array([20.0, 200.0]), 20.0, 3.0, 45.0)
    ramp = np.linspace(-1, 1, SIZE, dtype=np.float32)
    weights = torch.from_numpy(
        np.stack(
            [np.outer(ramp, np.ones(SIZE)), np.outer(np.ones(SIZE), ramp), np.ones((SIZE, SIZE)), np.outer(ramp, ramp)]
        )
    ).float()
    return extractor, field, cameras, weights


def _loss(chain: tuple, spp: int, silhouette_spp: int, seed: int) -> torch.Tensor:
    extractor, field, cameras, weights = chain
    surface = extractor(field)
    passes = GeometryPass(SIZE, spp, silhouette_spp)
    if silhouette_spp:
        pictures = passes.render(surface.vertices, surface.faces, surface.part_weight, cameras, seed)
    else:
        pictures = passes.render_primal(surface.vertices, surface.faces, surface.part_weight, cameras, seed)
    return (pictures[:, :4] * weights).sum()


@pytest.mark.parametrize("name", ["mlp", "grid"])
def test_directional_derivative_in_the_weights(chain: tuple, name: str) -> None:
    """In one group of weights, halfway between uphill and a random direction; the topology may change under way."""
    field = chain[1]
    group = {key: value for key, value in field.named_parameters() if key.startswith(name)}
    field.zero_grad()
    for seed in range(4):
        (_loss(chain, 64, 64, seed=11 + 2 * seed) / 4).backward()
    generator = torch.Generator().manual_seed(7)
    noise = {key: torch.randn(value.shape, generator=generator) for key, value in group.items()}
    uphill = torch.cat([value.grad.flatten() for value in group.values()]).norm()
    sideways = torch.cat([value.flatten() for value in noise.values()]).norm()
    direction = {key: value.grad / uphill + noise[key] / sideways for key, value in group.items()}
    analytic = sum(float((value.grad * direction[key]).sum()) for key, value in group.items())

    def moved(step: float) -> float:
        with torch.no_grad():
            for key, value in group.items():
                value += step * direction[key]
            result = float(_loss(chain, 1024, 0, seed=11))
            for key, value in group.items():
                value -= step * direction[key]
        return result

    numeric = (moved(STEP) - moved(-STEP)) / (2 * STEP)
    assert abs(analytic - numeric) <= 0.05 * abs(numeric), f"autodiff {analytic:.4f}, differences {numeric:.4f}"


def test_sdf_values_through_marching_tets_and_render() -> None:
    """Adding a constant to a ball's sdf makes the ball grow: d loss / d radius, silhouettes included."""
    from fd_mitsuba.extraction.marching_tets import crossing_faces_plain

    grid = TetGrid(20)
    points, tets = grid.vertices, grid.tets()
    cameras = CameraBatch.around(np.array([30.0]), 15.0, 3.0, 45.0)
    passes = GeometryPass(SIZE, 64, 64)

    def area(offset: torch.Tensor, primal: bool) -> torch.Tensor:
        sdf = 0.7 - points.norm(dim=1) + offset
        ends, faces = crossing_faces_plain(sdf.detach() > 0, tets)
        first, second = sdf[ends[:, 0]], sdf[ends[:, 1]]
        fraction = (first / (first - second))[:, None]
        vertices = points[ends[:, 0]] + fraction * (points[ends[:, 1]] - points[ends[:, 0]])
        weight = torch.zeros(len(vertices))
        if primal:
            return passes.render_primal(vertices, faces, weight, cameras, 3, spp=1024)[0, 3].sum()
        return passes.render(vertices, faces, weight, cameras, 3)[0, 3].sum()

    offset = torch.zeros((), requires_grad=True)
    area(offset, primal=False).backward()
    step = 0.02
    with torch.no_grad():
        numeric = float(area(torch.tensor(step), True) - area(torch.tensor(-step), True)) / (2 * step)
    assert float(offset.grad) == pytest.approx(numeric, rel=0.03)
