"""The surface of base minus part against closed forms and against marching tetrahedra of `soft_subtract`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.extraction.active_vertices import active_vertices
from fd_mitsuba.extraction.marching_tets import crossing_faces_plain, crossing_fraction
from fd_mitsuba.extraction.subtraction import SubtractionExtractor
from fd_mitsuba.extraction.surface import FAR_OUTSIDE
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.fields.union import soft_subtract

BASE_RADIUS, BITE_RADIUS = 0.6, 0.3
BITE_CENTRE = torch.tensor([0.013, 0.6, 0.021])
PLAIN = FieldConfig(levels=3, base_resolution=4, finest_resolution=16, log2_table=9, offsets=False)


def scene(resolution: int = 20, dtype: torch.dtype = torch.float32, k: float = 0.15) -> SubtractionExtractor:
    grid = TetGrid(resolution)
    points = grid.positions(torch.arange(grid.count), dtype)
    base, bite = BASE_RADIUS - points.norm(dim=1), BITE_RADIUS - (points - BITE_CENTRE).norm(dim=1)
    return SubtractionExtractor(grid, base, bite, active_vertices(grid, bite), k)


def grown(settings: FieldConfig = PLAIN) -> PartField:
    field, generator = PartField(settings, 0), torch.Generator().manual_seed(3)
    with torch.no_grad():
        field.grid.table.copy_(0.05 * torch.randn(field.grid.table.shape, generator=generator))
        field.mlp.weight_out.copy_(0.3 * torch.randn(field.mlp.weight_out.shape, generator=generator))
    return field


def as_mesh(surface: UnionSurface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.detach().numpy(), surface.faces.numpy(), process=False)


def reference(extractor: SubtractionExtractor, field: PartField) -> Tensor:
    """Corners (F, 3, 3) of the zero set of `soft_subtract`, from all vertices and all tetrahedra, without offsets."""
    grid = extractor.grid
    points = grid.positions(torch.arange(grid.count), extractor.sdf_base.dtype)
    sdf_part = field.evaluate(points, extractor.initial_sdf).sdf
    active = torch.zeros(grid.count, dtype=torch.bool).index_fill_(0, extractor.active_index, True)
    base = BASE_RADIUS - points.norm(dim=1)
    left = soft_subtract(base, torch.where(active, sdf_part, FAR_OUTSIDE), extractor.union_k)
    ends, faces = crossing_faces_plain(left.detach() >= 0, grid.tets())
    # From the end outside, so that the small numbers that keep gradients bounded fall on the same side.
    inner = torch.where(left.detach()[ends[:, 0]] >= 0, ends[:, 0], ends[:, 1])
    outer = ends.sum(dim=1) - inner
    fraction = crossing_fraction(-left[outer], -left[inner], grid.spacing)
    return (points[outer] + fraction[:, None] * (points[inner] - points[outer]))[faces]


def test_surface_and_gradient_are_those_of_soft_subtract() -> None:
    extractor, field = scene(dtype=torch.float64), grown().double()
    results = []
    for corners_of in (lambda: (s := extractor(field)).vertices[s.faces], lambda: reference(extractor, field)):
        field.zero_grad()
        corners = corners_of()
        # The volume does not depend on the order of faces, and hardly on how the quadrangles are split.
        volume = torch.linalg.det(corners) / 6
        vertices = np.unique(np.round(corners.detach().numpy().reshape(-1, 3), 9), axis=0)
        volume.sum().backward()
        results.append((vertices, float(volume.sum().detach()), [p.grad.clone() for p in field.parameters()]))
    (one, volume, grads), (other, expected, expected_grads) = results
    assert one.shape == other.shape and np.abs(one - other).max() < 1e-8
    assert volume == pytest.approx(expected, rel=1e-3) and volume > 0
    assert max(float(grad.abs().max()) for grad in grads) > 0
    for grad, wanted in zip(grads, expected_grads, strict=True):
        assert float((grad - wanted).norm()) < 0.02 * float(wanted.norm()) + 1e-9


def test_the_fast_surface_equals_the_plain_one_face_by_face() -> None:
    extractor = scene(dtype=torch.float64)
    field = grown(PLAIN.model_copy(update={"offsets": True})).double()
    fast, plain = extractor(field), extractor.extract_plain(field)
    both = []
    for surface in (fast, plain):
        rows = torch.cat([surface.vertices[surface.faces].mean(dim=1), surface.face_is_part[:, None]], dim=1)
        both.append(np.unique(np.round(rows.detach().numpy(), 8), axis=0))
    assert np.array_equal(both[0], both[1])


def test_a_bitten_ball_in_closed_form() -> None:
    """Two balls overlap in a lens whose volume is known."""
    surface = scene(resolution=48, k=0.0)(PartField(PLAIN))
    mesh, distance = as_mesh(surface), float(BITE_CENTRE.norm())
    big, small = BASE_RADIUS, BITE_RADIUS
    lens = math.pi * (big + small - distance) ** 2
    lens *= distance**2 + 2 * distance * (big + small) - 3 * (big - small) ** 2
    lens /= 12 * distance
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * big**3 - lens, rel=0.01)
    cell = 2.1 / 48
    from_bite = np.linalg.norm(mesh.triangles_center - BITE_CENTRE.numpy(), axis=1) - small
    from_base = np.linalg.norm(mesh.triangles_center, axis=1) - big
    is_cut = surface.face_is_part.numpy()
    assert np.abs(from_bite[is_cut]).max() < cell and np.abs(from_base[~is_cut]).max() < cell
    # Seen from the remaining solid, the cut's faces look towards the bite's centre.
    towards = BITE_CENTRE.numpy() - mesh.triangles_center[is_cut]
    assert (np.einsum("ij,ij->i", mesh.face_normals[is_cut], towards) > 0).mean() > 0.99


def test_the_bases_own_faces_come_first_and_never_change() -> None:
    extractor, field = scene(), grown()
    first, second = extractor(PartField(PLAIN)), extractor(field)
    faces, vertices = extractor.static_faces, extractor.static_vertices
    assert faces > 100 and vertices > 50
    assert torch.equal(first.faces[:faces], second.faces[:faces])
    assert torch.equal(first.vertices[:vertices], second.vertices[:vertices])
    assert not second.face_is_part[:faces].any()
    assert int(second.faces[:faces].max()) < vertices
