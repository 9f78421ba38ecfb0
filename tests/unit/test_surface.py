from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.extraction.active_vertices import active_vertices
from fd_mitsuba.extraction.marching_tets import crossing_faces, edge_ends
from fd_mitsuba.extraction.surface import SurfaceExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.part_sdf import PartField

SMALL = FieldConfig(levels=4, base_resolution=4, finest_resolution=20, log2_table=10)
BASE_CENTRE, BASE_RADIUS = torch.tensor([0.013, -0.2, 0.007]), 0.5
PART_CENTRE, PART_RADIUS = torch.tensor([0.011, 0.4, 0.017]), 0.25


def base_sdf(p: torch.Tensor) -> torch.Tensor:
    return BASE_RADIUS - (p - BASE_CENTRE).norm(dim=1)


def region_sdf(p: torch.Tensor) -> torch.Tensor:
    return PART_RADIUS - (p - PART_CENTRE).norm(dim=1)


def scene(resolution: int = 20, dtype: torch.dtype = torch.float32, **options) -> SurfaceExtractor:
    grid = TetGrid(resolution)
    p = grid.positions(torch.arange(grid.count), dtype)
    return SurfaceExtractor(grid, base_sdf(p), region_sdf(p), active_vertices(grid, region_sdf(p)), **options)


def grown_field(seed: int = 0, size: float = 1.0, settings: FieldConfig = SMALL) -> PartField:
    """A field far from its start: bumpy and with large offsets."""
    field = PartField(settings, seed)
    generator = torch.Generator().manual_seed(seed + 10)
    with torch.no_grad():
        field.grid.table.copy_(0.05 * torch.randn(field.grid.table.shape, generator=generator))
        field.mlp.weight_out.copy_(size * torch.randn(field.mlp.weight_out.shape, generator=generator))
        field.mlp.weight_out[0] *= 0.3
    return field


def as_mesh(surface: UnionSurface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.detach().numpy(), surface.faces.numpy(), process=False)


def same_order(surface: UnionSurface) -> tuple[np.ndarray, np.ndarray]:
    """Corner positions and weights (F, 12), triangles in a defined order, and their labels, to compare extractions."""
    attributes = torch.cat([surface.vertices, surface.part_weight[:, None]], dim=1).detach().double().numpy()
    corners = attributes[surface.faces.numpy()]
    keys = np.round(corners[..., :3], 4)
    first = np.array([min(range(3), key=lambda i: tuple(face[i])) for face in keys])
    corners = np.stack([np.take_along_axis(corners, ((first + k) % 3)[:, None, None], 1)[:, 0] for k in range(3)], 1)
    flat = corners.reshape(len(corners), -1)
    order = np.lexsort(np.round(flat, 4).T)
    return flat[order], surface.face_is_part.numpy()[order]


@pytest.mark.parametrize("options", [{}, {"union_k": 0.0}, {"union_only_outside": True}])
def test_the_fast_surface_equals_the_plain_one(options):
    extractor, field = scene(dtype=torch.float64, **options), grown_field().double()
    fast, plain = extractor(field), extractor.extract_plain(field)
    assert fast.vertices.shape == plain.vertices.shape and fast.faces.shape == plain.faces.shape
    (one, one_labels), (other, other_labels) = same_order(fast), same_order(plain)
    assert np.abs(one - other).max() < 1e-10 and (one_labels == other_labels).all()


def test_the_fast_gradients_equal_the_plain_ones():
    extractor, field = scene(), grown_field()
    samples = extractor.active_index[torch.tensor([3, 50, 50, 200])]
    gradients = []
    for extract in (extractor, extractor.extract_plain):
        field.zero_grad()
        surface = extract(field, samples)
        loss = surface.vertices.square().sum() + surface.part_weight.sum() + 10 * surface.sample_sdf.square().sum()
        loss.backward()
        gradients.append([parameter.grad.clone() for parameter in field.parameters()])
    for one, other in zip(*gradients, strict=True):
        assert (one - other).norm() < 1e-3 * other.norm()


def test_the_union_is_one_closed_welded_mesh():
    surface = scene(32)(grown_field(size=0.2))
    mesh = as_mesh(surface)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert len(np.unique(surface.faces.numpy())) == len(surface.vertices)
    assert surface.vertices.dtype == torch.float32 and surface.faces.dtype == torch.int64


def test_it_starts_as_the_union_of_base_and_region():
    extractor = scene(40, union_k=0.0)
    mesh = as_mesh(extractor(PartField(SMALL)))
    distance = PART_CENTRE.sub(BASE_CENTRE).norm().item()
    r, s = BASE_RADIUS, PART_RADIUS
    lens = math.pi * (r + s - distance) ** 2 * (distance**2 + 2 * distance * (r + s) - 3 * (r - s) ** 2)
    expected = 4 / 3 * math.pi * (r**3 + s**3) - lens / (12 * distance)
    assert mesh.volume == pytest.approx(expected, rel=0.01)
    vertices, faces = extractor.extract_part(PartField(SMALL))
    part = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert region_sdf(vertices).abs().max() < 0.5 * extractor.grid.spacing
    assert part.is_watertight and part.volume == pytest.approx(4 / 3 * math.pi * s**3, rel=0.03)


def test_labels_follow_the_seam():
    surface = scene(32)(PartField(SMALL))
    centre = surface.vertices.detach()[surface.faces].mean(dim=1)
    lead = region_sdf(centre) - base_sdf(centre)
    clear = lead.abs() > 0.04
    assert (surface.face_is_part[clear] == (lead[clear] > 0)).all()
    assert surface.part_weight.min() == 0 and surface.part_weight.max() == 1
    between = (surface.part_weight > 0) & (surface.part_weight < 1)
    assert between.any()
    assert (region_sdf(surface.vertices) - base_sdf(surface.vertices))[between].abs().max() < 0.1


def test_offsets_leave_every_vertex_of_the_bases_own_surface_bit_identical():
    extractor = scene(24)
    field = grown_field(size=30.0)
    with torch.no_grad():
        field.mlp.weight_out[0] *= 0.01
    still = grown_field(size=30.0, settings=SMALL.model_copy(update={"offsets": False}))
    still.load_state_dict(field.state_dict())
    moved, unmoved = extractor(field), extractor(still)
    assert torch.equal(moved.faces, unmoved.faces)
    changed = (moved.vertices != unmoved.vertices).any(dim=1)
    step = (moved.vertices - unmoved.vertices).abs().max()
    assert 0.3 * extractor.grid.spacing < step <= 0.5001 * extractor.grid.spacing
    side = extractor.grid.side
    sdf = extractor.sdf_base.view((side,) * 3)
    edges, _ = crossing_faces(sdf > 0)
    surface_ends = torch.stack(edge_ends(edges, (side,) * 3)).unique()
    assert not torch.isin(extractor.active_index[extractor.movable], surface_ends).any()
    base_only = SurfaceExtractor(extractor.grid, extractor.sdf_base, extractor.initial_sdf, extractor.active_index[:0])
    known = {tuple(v) for v in base_only(still).vertices.tolist()}
    on_base = torch.tensor([tuple(v) in known for v in unmoved.vertices.tolist()])
    assert on_base.sum() > 500 and changed.sum() > 100
    assert not changed[on_base].any()


def test_samples_come_in_the_callers_order_and_must_be_active():
    extractor, field = scene(), grown_field()
    samples = extractor.active_index[torch.tensor([9, 2, 2, 100])]
    surface = extractor(field, samples)
    expected = extractor.part_sdf(field)[torch.tensor([9, 2, 2, 100])]
    torch.testing.assert_close(surface.sample_sdf, expected)
    torch.testing.assert_close(extractor.extract_plain(field, samples).sample_sdf, expected, rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="active_index"):
        extractor(field, torch.tensor([0]))


def test_the_directional_derivative_agrees_with_finite_differences():
    extractor, field = scene(16, torch.float64), grown_field(size=0.2).double()
    weights = torch.randn(3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss() -> torch.Tensor:
        surface = extractor(field)
        corners = surface.vertices[surface.faces]
        volume = torch.linalg.det(corners).sum() / 6
        return volume + (corners[:, 0] @ weights).mean() + surface.part_weight.mean()

    parameters = list(field.parameters())
    generator = torch.Generator().manual_seed(1)
    direction = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parameters]
    analytic = sum((g * d).sum() for g, d in zip(torch.autograd.grad(loss(), parameters), direction, strict=True))
    step, values = 1e-7, []
    for sign in (1, -1):
        with torch.no_grad():
            for p, d in zip(parameters, direction, strict=True):
                p.add_(d, alpha=sign * step * (1 if sign > 0 else 2))
        values.append(loss().item())
    assert (values[0] - values[1]) / (2 * step) == pytest.approx(analytic.item(), rel=1e-4)


def test_the_part_alone_is_closed_also_at_the_grids_border_and_can_be_cut_by_name():
    grid = TetGrid(20)
    p = grid.vertices
    regions = torch.stack([0.3 - (p - torch.tensor([x, 0.0, 0.95])).norm(dim=1) for x in (-0.5, 0.5)])
    extractor = SurfaceExtractor(grid, base_sdf(p), regions.amax(0), active_vertices(grid, regions.amax(0)))
    field = PartField(SMALL)
    whole = trimesh.Trimesh(*(t.numpy() for t in extractor.extract_part(field)), process=False)
    left = trimesh.Trimesh(*(t.numpy() for t in extractor.extract_part(field, regions[0])), process=False)
    assert whole.is_watertight and whole.body_count == 2 and whole.bounds.max() < 1.05
    assert left.is_watertight and left.body_count == 1 and left.vertices[:, 0].max() < 0
    assert as_mesh(extractor(field)).is_watertight


def test_without_active_vertices_the_surface_is_the_base():
    grid = TetGrid(16)
    p = grid.vertices
    extractor = SurfaceExtractor(grid, base_sdf(p), region_sdf(p), torch.empty(0, dtype=torch.int64))
    surface = extractor(PartField(SMALL))
    assert as_mesh(surface).is_watertight and surface.part_weight.abs().max() == 0 and not surface.face_is_part.any()
    assert surface.sample_sdf.shape == (0,)


def test_no_surface_at_all_gives_empty_tensors():
    grid = TetGrid(10)
    nothing = torch.full((grid.count,), -1.0)
    extractor = SurfaceExtractor(grid, nothing, nothing, active_vertices(grid, region_sdf(grid.vertices)))
    for surface in (extractor(PartField(SMALL)), extractor.extract_plain(PartField(SMALL))):
        assert surface.vertices.shape == surface.faces.shape == (0, 3)
        assert surface.part_weight.shape == surface.face_is_part.shape == (0,)
        surface.vertices.sum().backward()
    vertices, faces = extractor.extract_part(PartField(SMALL))
    assert vertices.shape == faces.shape == (0, 3)


def test_repeated_calls_agree_bit_for_bit():
    extractor, field = scene(), grown_field()
    results = []
    for _ in range(2):
        field.zero_grad()
        surface = extractor(field)
        surface.vertices.square().sum().backward()
        results.append((surface.vertices.detach(), surface.faces, field.grid.table.grad.clone()))
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))
