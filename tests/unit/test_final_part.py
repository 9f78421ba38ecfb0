"""The final surface of a part against closed forms: balls on a ball, whose every function is known."""

from __future__ import annotations

import math
from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import torch
from test_part_solid import BASE_RADIUS, NO_OFFSETS, ball_volume, check, fresh_extractor, lens, stage_of
from test_surface_quality import BOX

from fd_mitsuba.evaluation.joint import joint_curves, measure_joint
from fd_mitsuba.export.final_surface import meshing
from fd_mitsuba.export.final_surface.final_part import FinalPart, final_part, final_parts, part_function
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.export.solid.part_solid import SINK_CELLS, lattice_part, part_solid
from fd_mitsuba.extraction.grown_part import GrownPart
from fd_mitsuba.extraction.subtraction import SubtractionExtractor
from fd_mitsuba.extraction.surface import SurfaceExtractor
from fd_mitsuba.fields.part_sdf import PartField, PartValues
from fd_mitsuba.fields.union import soft_union
from fd_mitsuba.scene.focal_region import FocalRegion, union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

FACES = 4000
CENTRE, RADIUS = np.array([0.0, 0.62, 0.0]), 0.25


def one_ball(k: float = 0.15) -> GrownPart:
    return stage_of({"part": [(tuple(CENTRE), RADIUS)]}, k=k)


def outside(part: FinalPart) -> np.ndarray:
    return np.linalg.norm(part.solid.vertices, axis=1) > BASE_RADIUS


def test_without_fillet_it_is_the_ball_outside_of_the_base_and_sunk_inside() -> None:
    stage = one_ball(k=0.0)
    part = final_part(stage, None, FACES)
    check(part.solid)
    spacing, vertices = stage.grid.spacing, part.solid.vertices
    from_ball = np.linalg.norm(vertices - CENTRE, axis=1) - RADIUS
    assert np.abs(from_ball[outside(part)]).max() < 0.002 * spacing
    assert part.distance.max() < 0.002 * spacing
    deepest = BASE_RADIUS - SINK_CELLS * spacing
    assert np.linalg.norm(vertices, axis=1).min() == pytest.approx(deepest, abs=0.03 * spacing)
    base = manifold3d.Manifold.sphere(BASE_RADIUS, 512)
    shown = (part.solid.to_manifold() - base).volume()
    assert shown == pytest.approx(ball_volume(RADIUS) - lens(RADIUS, BASE_RADIUS, CENTRE[1]), rel=0.005)


def test_triangles_are_even_and_as_many_as_wanted() -> None:
    for faces in (2000, 6000):
        solid = final_part(one_ball(), None, faces).solid
        assert 0.75 * faces < len(solid.faces) <= faces
        angles = smallest_angles(solid.vertices, solid.faces)
        assert np.percentile(angles, 5) > 28 and angles.min() > 11


def test_a_small_part_gets_no_more_faces_than_show_something() -> None:
    solid = final_part(one_ball(), None, 500_000).solid
    assert len(solid.faces) < 100_000
    sides = solid.vertices[solid.faces]
    lengths = np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2)
    assert lengths.mean() == pytest.approx(0.2 * 2.1 / 40, rel=0.1)


def test_normals_are_the_balls() -> None:
    part = final_part(one_ball(k=0.0), None, FACES)
    offset = part.solid.vertices - CENTRE
    on_ball = np.linalg.norm(part.solid.vertices, axis=1) > BASE_RADIUS + 0.08  # two cells and a half from the joint
    cosine = np.einsum("ij,ij->i", part.normals, offset / np.linalg.norm(offset, axis=1, keepdims=True))
    assert on_ball.sum() > 700 and cosine[on_ball].min() > np.cos(np.radians(0.8))
    assert np.abs(np.linalg.norm(part.normals, axis=1) - 1).max() < 1e-9


def test_the_fillet_is_little_higher_than_the_unions_and_has_no_crease() -> None:
    stage = one_ball()
    part = final_part(stage, None, 30_000)
    check(part.solid)
    from_base = np.linalg.norm(part.solid.vertices, axis=1) - BASE_RADIUS
    from_ball = np.linalg.norm(part.solid.vertices - CENTRE, axis=1) - RADIUS
    between = (np.abs(from_base - from_ball) < 0.1 * stage.grid.spacing) & (from_base > 0)
    # soft_union is 0 where max + 0.1 k = 0; the foot lifts that.
    lifted = from_base[between] - 0.1 * 0.15
    assert between.sum() > 20 and lifted.min() > 0 and lifted.max() < 0.2 * stage.grid.spacing
    union = stage.extractor(stage.field)
    to_solid = MeshDistance(part.solid.vertices, part.solid.faces).unsigned(union.vertices.detach().numpy())
    assert to_solid[union.part_weight.detach().numpy() > 0.99].max() < 0.25 * stage.grid.spacing
    # Where the part rises from the base, the angle between faces side by side stays small.
    corners = part.solid.vertices[part.solid.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    keys = np.sort(np.stack([part.solid.faces, np.roll(part.solid.faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    order = np.lexsort(keys.T)
    pairs = order.reshape(-1, 2) // 3
    above = (from_base[part.solid.faces[pairs]] > 0.3 * stage.grid.spacing).all(axis=(1, 2))
    cosine = np.einsum("ij,ij->i", normal[pairs[above, 0]], normal[pairs[above, 1]])
    assert above.sum() > 1000 and np.degrees(np.arccos(cosine.min())) < 30


def test_the_joint_is_one_smooth_circle() -> None:
    stage = one_ball()
    base = MeshDistance(stage.base.vertices, stage.base.faces)
    spacing = stage.grid.spacing
    joint = measure_joint(*(lambda s: (s.vertices, s.faces))(final_part(stage, None, FACES).solid), base, spacing)
    before = measure_joint(*(lambda s: (s.vertices, s.faces))(part_solid(stage, None)), base, spacing)
    assert joint.curves == 1 and joint.notches.max() < 0.1
    radius = joint.length / (2 * np.pi)
    assert np.percentile(joint.turning_deg, 95) < 1.5 * np.degrees(1 / radius) < np.percentile(before.turning_deg, 95)
    # Of a circle of latitude the ball turns sin(theta) parts, the circle itself in the surface cos(theta).
    upright = math.sqrt(1 - (radius * spacing / BASE_RADIUS) ** 2)
    assert np.median(joint.sideways_deg) == pytest.approx(upright * np.degrees(1 / radius), rel=0.05)


def test_a_wide_fillet_ends_too() -> None:
    """One of eighteen cells: the rim is further from the part than any of a default run."""
    stage = stage_of({"part": [(tuple(CENTRE), RADIUS)]}, resolution=64, k=0.6)
    part = final_part(stage, None, 2 * FACES)
    check(part.solid)
    base, spacing = MeshDistance(stage.base.vertices, stage.base.faces), stage.grid.spacing
    joint = measure_joint(part.solid.vertices, part.solid.faces, base, spacing)
    assert part.distance.max() < 0.1 * spacing
    assert joint.curves == 1 and np.percentile(joint.turning_deg, 95) < 1.3 * 360 / joint.length


def joint_circle(stage: GrownPart) -> np.ndarray:
    """The distances from the y axis along the one curve in which the part meets the base."""
    solid = final_part(stage, None, FACES).solid
    (curve,) = joint_curves(solid.vertices, solid.faces, MeshDistance(stage.base.vertices, stage.base.faces))
    return np.linalg.norm(curve[:, [0, 2]], axis=1)


def test_the_joint_has_no_teeth_and_shows_nothing_of_what_is_hidden() -> None:
    visible = one_ball()
    turn = np.radians(38.0)
    hidden = tuple((BASE_RADIUS - 0.095) * np.array([np.sin(turn), np.cos(turn), 0.0]))
    both = stage_of({"part": [(tuple(CENTRE), RADIUS), (hidden, 0.08)]})
    for stage in (visible, both):
        radius = joint_circle(stage)
        assert radius.min() > 0.19 + 0.5 * stage.grid.spacing and np.ptp(radius) < 0.05 * stage.grid.spacing


class Kinked(PartField):
    """A ball whose radius goes up and down along x, with kinks between the lattice's vertices."""

    def evaluate(self, points: torch.Tensor, initial_sdf: torch.Tensor) -> PartValues:
        wave = ((points[:, 0] / 0.13 + 0.3) % 2 - 1).abs()
        return PartValues(initial_sdf + 0.01 * wave, torch.zeros_like(points))


def test_between_the_vertices_of_the_training_the_field_has_no_kink() -> None:
    stage = replace(one_ball(), field=Kinked())
    function = part_function(stage, lattice_part(stage, None), 2)
    vertices = stage.grid.vertices.numpy()
    vertices = vertices[np.abs(np.linalg.norm(vertices - CENTRE, axis=1) - RADIUS) < 2 * stage.grid.spacing]
    region = torch.from_numpy(union_sdf([region for own in stage.parts.values() for region in own], vertices)).float()
    trained = stage.field.evaluate(torch.from_numpy(vertices).float(), region).sdf.numpy()
    assert np.abs(function.part_values(vertices) - trained).max() < 1e-5
    # At its kinks the field's own slope along x jumps by 0.02 / 0.13.
    kinks = np.stack([np.full(200, 0.7 * 0.13), np.linspace(0.75, 0.8, 200), np.linspace(-0.1, 0.1, 200)], axis=1)
    slopes = []
    for sign in (-1, 1):
        at = kinks + np.array([sign * 0.002, 0, 0])
        step = np.array([0.001, 0, 0])
        ends = [function.part_values(at + way * step) - np.linalg.norm(CENTRE - at - way * step, axis=1) * -1
                for way in (-1, 1)]  # fmt: skip
        slopes.append((ends[1] - ends[0]) / 0.002)
    assert np.abs(slopes[1] - slopes[0]).max() < 0.25 * 0.02 / 0.13


def test_a_gap_is_bridged_as_the_grid_has_decided() -> None:
    stage = stage_of({"part": [((0.0, BASE_RADIUS + 0.08 + 0.2, 0.0), 0.2)]})
    part = final_part(stage, None, FACES)
    check(part.solid)
    assert part.solid.bridged == part_solid(stage, None).bridged > 0
    assert part.solid.gap(stage.base) == 0.0 and part.solid.pieces().max() == 0
    far = part.solid.vertices[:, 1] > BASE_RADIUS + 0.08 + 2 * part.solid.bridged + stage.grid.spacing
    away = np.linalg.norm(part.solid.vertices[far] - [0, BASE_RADIUS + 0.28, 0], axis=1) - 0.2
    assert far.sum() > 50 and np.abs(away).max() < 1e-3


def test_islands_go_and_what_floats_stays() -> None:
    balls = [((0.0, 0.62, 0.0), 0.25), ((0.8, 0.6, 0.0), 0.04), ((-0.8, 0.6, 0.0), 0.04)]
    solid = final_part(stage_of({"part": balls}), None, FACES).solid
    check(solid)
    assert solid.islands_removed == 2 and np.abs(solid.vertices[:, 0]).max() < 0.5
    floating = final_part(stage_of({"part": [((0.0, 0.85, 0.0), 0.15)]}), None, FACES).solid
    assert floating.volume == pytest.approx(ball_volume(0.15), rel=0.005)


def dent(points: torch.Tensor) -> torch.Tensor:
    """What makes a void of about .06 radius in the middle of a ball, and nothing at its surface."""
    return 0.4 * torch.exp(-((points - torch.tensor([0.0, 0.75, 0.0])).norm(dim=1) ** 2) / 0.08**2)


class Hollow(PartField):
    """A ball with a ball-shaped void."""

    def evaluate(self, points: torch.Tensor, initial_sdf: torch.Tensor) -> PartValues:
        return PartValues(initial_sdf - dent(points), torch.zeros_like(points))


def test_pockets_are_filled() -> None:
    stage = stage_of({"part": [((0.0, 0.75, 0.0), 0.25)]})
    full = final_part(stage, None, FACES).solid
    values, positions = stage.extractor.lattice_values(stage.field)
    hollow = values - dent(positions)
    stage.extractor.lattice_values = lambda field: (hollow, positions)
    solid = final_part(replace(stage, field=Hollow()), None, FACES).solid
    check(solid)
    assert solid.volume == pytest.approx(full.volume, rel=1e-3)


def test_named_parts_are_solids_of_their_own_and_fill_the_whole() -> None:
    balls = {"left": [((-0.15, 0.6, 0.0), 0.22)], "right": [((0.15, 0.6, 0.03), 0.22)]}
    stage = stage_of(balls)
    parts, whole = final_parts(stage, FACES), final_part(stage, None, FACES).solid
    left, right = parts["left"].solid, parts["right"].solid
    for solid in (left, right, whole):
        check(solid)
    assert left.volume + right.volume == pytest.approx(whole.volume, rel=0.005)
    assert (left.to_manifold() ^ right.to_manifold()).volume() < 1e-3 * whole.volume


def test_a_part_that_is_cut_out_is_the_ball_itself() -> None:
    stage = one_ball()
    cutting = replace(stage, extractor=fresh_extractor(stage.extractor, SubtractionExtractor))
    part = final_part(cutting, None, FACES)
    check(part.solid)
    assert part.solid.volume == pytest.approx(ball_volume(RADIUS), rel=0.005)
    assert np.abs(np.linalg.norm(part.solid.vertices - CENTRE, axis=1) - RADIUS).max() < 1e-4


def test_edges_of_a_box_stay() -> None:
    """Its edge is rounded by less than a cell of the training: far from the base, the field is the box itself."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.2 + [0, 0.8, 0]
    stage = one_ball(k=0.0)
    box = FocalRegion("part", np.eye(4), "part", TriangleMesh("box", corners, np.array(BOX)))
    region_sdf = torch.from_numpy(union_sdf([box], stage.grid.vertices.numpy()))
    active = (region_sdf > -0.15).nonzero()[:, 0]
    extractor = SurfaceExtractor(stage.grid, stage.extractor.sdf_base, region_sdf, active, 0.0)
    solid = final_part(replace(stage, parts={"part": (box,)}, extractor=extractor), None, 20_000).solid
    check(solid)
    along = np.linspace(0.62, 0.98, 200)
    edge = np.stack([np.full(200, 0.2), along, np.full(200, 0.2)], axis=1)
    # A quarter circle of radius r leaves r (sqrt(2) - 1) to the edge.
    gone = MeshDistance(solid.vertices, solid.faces).unsigned(edge).max()
    assert gone / (math.sqrt(2) - 1) < stage.grid.spacing


def test_a_thin_plate_has_no_groove_above_its_joint() -> None:
    """A plate a cell and a half thick on the base: from where it stands it only becomes narrower, and then stays."""
    stage = one_ball()
    cell = stage.grid.spacing
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.75 * cell, 0.25, 0.3]
    plate = FocalRegion("part", np.eye(4), "part", TriangleMesh("plate", corners + [0, 0.7, 0], np.array(BOX)))
    region_sdf = torch.from_numpy(union_sdf([plate], stage.grid.vertices.numpy()))
    active = (region_sdf > -0.15).nonzero()[:, 0]
    extractor = SurfaceExtractor(stage.grid, stage.extractor.sdf_base, region_sdf, active, 0.15)
    grown = replace(stage, parts={"part": (plate,)}, extractor=extractor)
    function = part_function(grown, lattice_part(grown, None), 4)
    heights, across = np.linspace(0.3, 4, 38) * cell, np.linspace(0, 3 * cell, 301)
    points = np.stack(np.meshgrid(across, heights + BASE_RADIUS, [0.0], indexing="ij"), axis=-1)[:, :, 0]
    inside = function.values(points.reshape(-1, 3)).reshape(points.shape[:2]) > 0
    width = across[inside.sum(axis=0) - 1]
    assert inside[0].all() and np.diff(width).max() < 0.03 * cell
    assert width[-1] == pytest.approx(0.75 * cell, abs=0.05 * cell) and width[0] > cell


class Level(PartField):
    """A ball, around which the field stays little below zero over a wide strip, as under a hat's brim."""

    def __init__(self, level: float) -> None:
        super().__init__(NO_OFFSETS)
        self.level = level

    def evaluate(self, points: torch.Tensor, initial_sdf: torch.Tensor) -> PartValues:
        sideways = (points[:, [0, 2]].norm(dim=1) - 0.34).clamp(min=0)
        upward = (points.norm(dim=1) - BASE_RADIUS - 0.1).clamp(min=0)
        level = self.level - 0.5 * (sideways + upward + (-points[:, 1]).clamp(min=0))
        return PartValues(torch.maximum(initial_sdf, level), torch.zeros_like(points))


@pytest.mark.parametrize(("level", "stays"), [(-0.013, True), (-0.0195, False)])
def test_what_the_training_showed_of_a_level_field_stays_and_a_mere_film_does_not(level: float, stays: bool) -> None:
    stage = replace(one_ball(), field=Level(level))
    heights = torch.linspace(0, 0.1, 200)
    union = soft_union(-heights, torch.full_like(heights, level), 0.15)
    film = float(heights[union > 0].max())
    assert film > 0.13 * 0.15 if stays else 0 < film < 0.13 * 0.15, (
        "the premise: what the training shows over the strip"
    )
    solid = final_part(stage, None, FACES).solid
    check(solid)
    outside = np.linalg.norm(solid.vertices, axis=1) > BASE_RADIUS + 0.02
    reach = np.linalg.norm(solid.vertices[outside][:, [0, 2]], axis=1).max()
    assert (0.29 if stays else 0.2) < reach < (0.38 if stays else 0.27)


def test_nothing_gives_no_faces() -> None:
    stage = one_ball()
    positions = stage.grid.vertices
    stage.extractor.lattice_values = lambda field: (torch.full((len(positions),), -10.0), positions)
    assert len(final_part(stage, None, FACES).solid.faces) == 0


def test_what_comes_out_no_solid_is_replaced_by_the_trainings_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    stage, lines = one_ball(), []

    def torn(vertices: np.ndarray, faces: np.ndarray, *_: object) -> tuple[np.ndarray, np.ndarray]:
        return vertices, faces[50:]

    monkeypatch.setattr(meshing, "remesh", torn)
    part = final_part(stage, "part", FACES, lines.append)
    assert np.array_equal(part.solid.faces, part_solid(stage, "part").faces) and len(part.normals) == len(
        part.solid.vertices
    )
    assert len(lines) == 1 and "part part" in lines[0] and "training" in lines[0]


def test_fewer_faces_keep_the_shape_and_the_normals() -> None:
    full = final_part(one_ball(k=0.0), None, 20_000)
    small = full.decimated(1000)
    check(small.solid)
    assert len(small.solid.faces) <= 1000 and full.decimated(10**6) is full
    offset = small.solid.vertices - CENTRE
    on_ball = np.linalg.norm(small.solid.vertices, axis=1) > BASE_RADIUS + 0.03
    cosine = np.einsum("ij,ij->i", small.normals, offset / np.linalg.norm(offset, axis=1, keepdims=True))
    assert on_ball.sum() > 100 and cosine[on_ball].min() > np.cos(np.radians(3))


def test_the_same_twice() -> None:
    one, other = (final_part(one_ball(), None, FACES) for _ in range(2))
    assert np.array_equal(one.solid.vertices, other.solid.vertices) and np.array_equal(one.normals, other.normals)
