"""The part's solid against closed forms, and against manifold3d, trimesh and libigl."""

from __future__ import annotations

import math
from dataclasses import replace

import igl
import manifold3d
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.part_record import anchor
from fd_mitsuba.export.solid.part_pieces import BRIDGE_REACH
from fd_mitsuba.export.solid.part_solid import SINK_CELLS, fillet_reach, part_solid
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.extraction.active_vertices import active_vertices
from fd_mitsuba.extraction.grown_part import GrownPart
from fd_mitsuba.extraction.surface import FAR_OUTSIDE, SurfaceExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.scene.focal_region import FocalRegion, union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

BASE_RADIUS = 0.5
NO_OFFSETS = FieldConfig(levels=2, log2_table=8, finest_resolution=16, offsets=False)

Balls = dict[str, list[tuple[tuple[float, float, float], float]]]


def region(centre: tuple[float, float, float], radius: float, part: str = "part") -> FocalRegion:
    matrix = np.diag([radius, radius, radius, 1.0])
    matrix[:3, 3] = centre
    return FocalRegion(part, matrix, part)


def stage_of(balls: Balls, resolution: int = 40, k: float = 0.15, base_radius: float = BASE_RADIUS) -> GrownPart:
    """A ball as the base, and parts that are balls, exactly."""
    grid = TetGrid(resolution)
    points = grid.vertices
    parts = {name: tuple(region(*ball, name) for ball in list_) for name, list_ in balls.items()}
    sdf_region = torch.from_numpy(
        union_sdf([region for regions in parts.values() for region in regions], points.numpy())
    )
    sdf_base = base_radius - points.norm(dim=1)
    extractor = SurfaceExtractor(grid, sdf_base, sdf_region, active_vertices(grid, sdf_region), k)
    return GrownPart(parts, base_mesh(base_radius), extractor, PartField(NO_OFFSETS))


def fresh_extractor(known: SurfaceExtractor, kind: type[SurfaceExtractor] = SurfaceExtractor) -> SurfaceExtractor:
    """Another of the same grid, base and regions, for a field of another layout or for cutting out."""
    grid, region = known.grid, known.initial_sdf
    return kind(grid, known.sdf_base, region, active_vertices(grid, region), known.union_k)


def base_mesh(radius: float = BASE_RADIUS) -> TriangleMesh:
    vertices, faces = unit_sphere(5)
    return TriangleMesh("base", vertices * radius, faces)


def check(solid: Solid) -> None:
    """Closed, oriented, manifold, solid, in the eyes of three other libraries."""
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert igl.is_edge_manifold(solid.faces)[0] and np.all(igl.is_vertex_manifold(solid.faces))
    made = manifold3d.Manifold(manifold3d.Mesh(solid.vertices, solid.faces.astype(np.uint32)))
    assert made.status() == manifold3d.Error.NoError
    assert made.volume() == pytest.approx(mesh.volume, rel=1e-3)
    assert solid.manifold and solid.volume == pytest.approx(mesh.volume, rel=1e-4)


def ball_volume(radius: float) -> float:
    return 4 / 3 * math.pi * radius**3


def lens(a: float, b: float, distance: float) -> float:
    sides = distance**2 + 2 * distance * (a + b) - 3 * (a - b) ** 2
    return math.pi * (a + b - distance) ** 2 * sides / (12 * distance)


def test_a_ball_on_a_ball_without_fillet_has_the_volume_of_its_closed_form() -> None:
    distance, radius = 0.6, 0.25
    stage = stage_of({"part": [((0.0, distance, 0.0), radius)]}, k=0.0)
    solid = part_solid(stage, "part")
    check(solid)
    sink = SINK_CELLS * stage.grid.spacing
    # The part without what of it lies deeper in the base than the sink, and the rim that dives at 45 degrees around it.
    core = ball_volume(radius) - lens(radius, BASE_RADIUS - sink, distance)
    waist = math.sqrt(radius**2 - ((distance**2 + radius**2 - BASE_RADIUS**2) / (2 * distance)) ** 2)
    rim = 2 * math.pi * waist * sink**2
    assert core * 0.98 < solid.volume < core + rim


def test_the_share_outside_of_the_base_has_the_parts_volume_there() -> None:
    distance, radius = 0.6, 0.25
    stage = stage_of({"part": [((0.0, distance, 0.0), radius)]}, k=0.0)
    solid = part_solid(stage, "part")
    base = manifold3d.Manifold.sphere(BASE_RADIUS, 256)
    outside = (solid.to_manifold() - base).volume()
    assert outside == pytest.approx(ball_volume(radius) - lens(radius, BASE_RADIUS, distance), rel=0.1)
    vertices, faces = stage.extractor.extract_part(stage.field)  # as coarse as the solid itself
    grown = Solid(vertices.numpy(), faces.numpy()).to_manifold()
    assert outside == pytest.approx((grown - base).volume(), rel=0.01)


def test_the_visible_surface_is_the_unions_vertex_for_vertex() -> None:
    stage = stage_of({"part": [((0.0, 0.62, 0.0), 0.25)]})
    solid = part_solid(stage, None)
    check(solid)
    with torch.no_grad():
        union = stage.extractor(stage.field)
    to_union = MeshDistance(union.vertices.numpy(), union.faces.numpy()).unsigned(solid.vertices)
    outside = np.linalg.norm(solid.vertices, axis=1) > BASE_RADIUS
    assert to_union[outside].max() < 0.15 * stage.grid.spacing
    to_solid = MeshDistance(solid.vertices, solid.faces).unsigned(union.vertices.numpy())
    shown = np.linalg.norm(union.vertices.numpy(), axis=1) > BASE_RADIUS + 0.15 * stage.grid.spacing
    assert to_solid[shown].max() < 0.25 * stage.grid.spacing
    on_part = union.part_weight.numpy() == 1
    away = cKDTree(solid.vertices).query(union.vertices.numpy()[on_part])[0]
    # All but a few edges that start under the part and end beyond the fillet's reach, nearer to the base.
    assert on_part.sum() > 500 and np.mean(away < 1e-6) > 0.98 and away.max() < 0.15 * stage.grid.spacing


def test_the_fillet_ends_below_the_bases_surface_and_is_no_film_over_it() -> None:
    stage = stage_of({"part": [((0.0, 0.62, 0.0), 0.25)]})
    solid = part_solid(stage, None)
    contact = part_solid(stage_of({"part": [((0.0, 0.62, 0.0), 0.25)]}, k=0.0), None)
    assert solid.volume > contact.volume
    to_part = np.linalg.norm(solid.vertices - np.array([0.0, 0.62, 0.0]), axis=1) - 0.25
    on_base = np.linalg.norm(solid.vertices, axis=1) > BASE_RADIUS
    reach = fillet_reach(0.15, stage.grid.spacing)
    assert to_part[on_base].max() < reach + stage.grid.spacing
    assert to_part.max() < reach + (SINK_CELLS + 1) * stage.grid.spacing
    assert np.linalg.norm(solid.vertices, axis=1).min() > BASE_RADIUS - (SINK_CELLS + 0.1) * stage.grid.spacing


@pytest.mark.parametrize("k", [0.05, 0.15, 0.3])
def test_fillet_reach(k: float) -> None:
    spacing = 2.1 / 64
    distance = fillet_reach(k, spacing)
    assert 0.1 * (k - distance) ** 2 / k == pytest.approx(0.12 * spacing)
    assert fillet_reach(0.0, spacing) == fillet_reach(0.001, spacing) == 0.0


def test_the_part_joins_the_base_without_a_gap() -> None:
    for height in (0.5, 0.65, 0.76):  # the last one ends 0.01 before the base: the fillet closes that
        solid = part_solid(stage_of({"part": [((0.0, height, 0.0), 0.25)]}), None)
        check(solid)
        assert solid.gap(base_mesh()) == 0.0 and solid.bridged == 0.0
        made = manifold3d.Manifold.sphere(BASE_RADIUS, 128) + solid.to_manifold()
        assert made.status() == manifold3d.Error.NoError and len(made.decompose()) == 1


@pytest.mark.parametrize("gap", [0.045, 0.08])
def test_a_wider_gap_is_bridged(gap: float) -> None:
    centre = np.array([0.0, BASE_RADIUS + gap + 0.2, 0.0])
    stage = stage_of({"part": [(tuple(centre), 0.2)]})
    solid = part_solid(stage, None)
    check(solid)
    assert 0 < solid.bridged <= BRIDGE_REACH and solid.gap(base_mesh()) == 0.0
    assert len(trimesh.Trimesh(solid.vertices, solid.faces, process=False).split(only_watertight=False)) == 1
    far = solid.vertices[:, 1] > BASE_RADIUS + gap + 2 * solid.bridged + 2 * stage.grid.spacing
    assert far.sum() > 50
    assert np.abs(np.linalg.norm(solid.vertices[far] - centre, axis=1) - 0.2).max() < 0.008  # left alone


def test_a_gap_is_bridged_also_where_the_field_falls_steeply() -> None:
    """Losses may leave any values outside of the part: six times the distance, here."""
    stage = stage_of({"part": [((0.0, BASE_RADIUS + 0.045 + 0.2, 0.0), 0.2)]})
    values = stage.extractor.lattice_values

    def steep(field: PartField) -> tuple[torch.Tensor, torch.Tensor]:
        sdf, positions = values(field)
        return torch.where(sdf < 0, 6 * sdf, sdf), positions

    stage.extractor.lattice_values = steep
    solid = part_solid(stage, None)
    check(solid)
    assert 0 < solid.bridged <= BRIDGE_REACH and solid.gap(base_mesh()) == 0.0
    assert len(trimesh.Trimesh(solid.vertices, solid.faces, process=False).split(only_watertight=False)) == 1


def test_what_floats_far_away_stays_and_its_gap_is_measured() -> None:
    solid = part_solid(stage_of({"part": [((0.0, 0.85, 0.0), 0.15)]}), None)
    check(solid)
    assert solid.bridged == 0.0
    assert solid.gap(base_mesh()) == pytest.approx(0.2, abs=0.005)
    assert solid.volume == pytest.approx(ball_volume(0.15), rel=0.08)


def test_only_the_piece_that_misses_the_base_swells() -> None:
    touching, short = (0.0, 0.62, 0.0), (0.0, -0.8, 0.0)
    solid = part_solid(stage_of({"part": [(touching, 0.2), (short, 0.25)]}), None)
    alone = part_solid(stage_of({"part": [(touching, 0.2)]}), None)
    assert solid.gap(base_mesh()) == 0.0 and solid.bridged > 0
    assert {tuple(v) for v in alone.vertices} == {tuple(v) for v in solid.vertices if v[1] > 0}


def test_islands_go_and_are_counted() -> None:
    stage = stage_of({"part": [((0.0, 0.62, 0.0), 0.25), ((0.8, 0.6, 0.0), 0.04), ((-0.8, 0.6, 0.0), 0.04)]})
    solid = part_solid(stage, None)
    check(solid)
    assert solid.islands_removed == 2 and np.abs(solid.vertices[:, 0]).max() < 0.5
    large = part_solid(stage_of({"part": [((0.0, 0.62, 0.0), 0.25), ((0.8, 0.5, 0.0), 0.1)]}), None)
    assert large.islands_removed == 0 and large.vertices[:, 0].max() > 0.85


def test_pockets_are_filled() -> None:
    stage = stage_of({"part": [((0.0, 0.75, 0.0), 0.25)]})
    full = part_solid(stage, None)
    values, positions = stage.extractor.lattice_values(stage.field)
    hollow = torch.minimum(values, (positions - torch.tensor([0.0, 0.8, 0.0])).norm(dim=1) - 0.1)
    stage.extractor.lattice_values = lambda field: (hollow, positions)
    solid = part_solid(stage, None)
    check(solid)
    assert solid.volume == pytest.approx(full.volume, rel=1e-3)


def test_named_parts_are_solids_of_their_own_and_fill_the_whole() -> None:
    balls = {"left": [((-0.15, 0.6, 0.0), 0.22)], "right": [((0.15, 0.6, 0.03), 0.22)]}
    stage = stage_of(balls)
    left, right, whole = part_solid(stage, "left"), part_solid(stage, "right"), part_solid(stage, None)
    for solid in (left, right, whole):
        check(solid)
    assert left.vertices[:, 0].max() < 0.1 and right.vertices[:, 0].min() > -0.1
    assert left.volume + right.volume == pytest.approx(whole.volume, rel=0.02)
    assert (left.to_manifold() ^ right.to_manifold()).volume() < 1e-4 * whole.volume


def test_a_small_named_part_is_no_island_of_the_large_one() -> None:
    solid = part_solid(stage_of({"body": [((0.0, 0.7, 0.0), 0.3)], "tip": [((0.0, -0.53, 0.0), 0.05)]}), "tip")
    check(solid)
    assert solid.islands_removed == 0


def test_nothing_gives_no_faces_and_a_wrong_name_one_line() -> None:
    stage = stage_of({"part": [((0.0, 0.6, 0.0), 0.25)]})
    with pytest.raises(UserError, match="no part 'wing'.*part"):
        part_solid(stage, "wing")
    positions = stage.grid.vertices
    stage.extractor.lattice_values = lambda field: (torch.full((len(positions),), FAR_OUTSIDE), positions)
    solid = part_solid(stage, None)
    assert len(solid.faces) == 0 and solid.volume == 0 and not solid.manifold and solid.gap(base_mesh()) == 0


def test_moved_vertices_keep_it_manifold() -> None:
    stage = stage_of({"part": [((0.0, 0.6, 0.0), 0.3)]}, resolution=32)
    field = PartField(FieldConfig(levels=4, log2_table=10, finest_resolution=20))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        field.grid.table.copy_(0.05 * torch.randn(field.grid.table.shape, generator=generator))
        field.mlp.weight_out.copy_(torch.randn(field.mlp.weight_out.shape, generator=generator))
        field.mlp.weight_out[0] *= 0.1
    check(part_solid(replace(stage, field=field, extractor=fresh_extractor(stage.extractor)), None))


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.6, 0.0, 0.8), (-0.48, -0.6, 0.64)])
@pytest.mark.parametrize("height", [0.62, 0.9])
def test_the_anchor_is_where_the_part_meets_the_base(direction: tuple[float, ...], height: float) -> None:
    centre = tuple(height * x for x in direction)
    solid, base = part_solid(stage_of({"part": [(centre, 0.2)]}), None), base_mesh()
    position, outward = anchor(solid, base, MeshDistance(base.vertices, base.faces))
    assert outward @ np.array(direction) > 0.99
    assert np.linalg.norm(np.cross(position, direction)) < 0.02
    depth = BASE_RADIUS - np.linalg.norm(position)
    assert 0 < depth < 0.12 if height < 0.7 else abs(depth) < 5e-3


def test_a_ring_has_an_anchor_too() -> None:
    """Its contact has no side: the direction is that to the part's middle, or up."""
    angles = [i * math.pi / 4 for i in range(8)]
    balls = {"part": [((0.5 * math.cos(angle), 0.1, 0.5 * math.sin(angle)), 0.25) for angle in angles]}
    solid, base = part_solid(stage_of(balls), None), base_mesh()
    check(solid)
    position, outward = anchor(solid, base, MeshDistance(base.vertices, base.faces))
    assert np.linalg.norm(outward) == pytest.approx(1.0) and np.linalg.norm(position[[0, 2]]) < 0.02
