"""Contacts, free ends and wall thickness of solids whose measures are known."""

from __future__ import annotations

from functools import reduce

import manifold3d
import numpy as np
import pytest

from fd_mitsuba.export.solid.contacts import contacts
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.export.solid.walls import measure_walls
from fd_mitsuba.runs.outcome_warnings import outcome_warnings
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import unit_sphere

BASE_RADIUS, THICK = 0.5, 0.05


def solid_of(made: manifold3d.Manifold) -> Solid:
    mesh = made.to_mesh64()
    return Solid(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))


def handle(gap: float) -> Solid:
    """A tube along an arc from inside the ball at the origin outward and back, to end `gap` before it."""
    turns = np.radians(np.linspace(-60.0, 60.0, 60))
    middle, radius = np.array([0.62, 0.0, 0.0]), 0.3
    path = middle + radius * np.stack([np.cos(turns * 2), np.sin(turns * 2), 0 * turns], axis=1)
    free = np.linalg.norm(path, axis=1) > BASE_RADIUS + THICK + gap
    keep = free | (path[:, 1] < 0)
    return solid_of(
        reduce(lambda one, other: one + other, [manifold3d.Manifold.sphere(THICK, 24).translate(p) for p in path[keep]])
    )


@pytest.fixture(scope="module")
def ball() -> MeshDistance:
    vertices, faces = unit_sphere(5)
    return MeshDistance(vertices * BASE_RADIUS, faces)


def test_a_handle_whose_end_hangs_free(ball: MeshDistance) -> None:
    part = handle(0.06)
    assert part.pieces().max() == 0  # one piece that touches the base: its gap tells nothing
    attached, free = contacts(part, ball)
    assert attached.gap == 0 and attached.position[1] < 0
    outside = part.vertices[part.vertices[:, 1] > 0]
    assert free.gap == pytest.approx(np.linalg.norm(outside, axis=1).min() - BASE_RADIUS, abs=1e-3)
    assert free.gap > 0.05 and free.position[1] > 0.2


def test_a_handle_with_both_ends_attached_and_parts_that_end_elsewhere(ball: MeshDistance) -> None:
    assert [found.gap for found in contacts(handle(-2 * THICK), ball)] == [0, 0]
    pin = solid_of(manifold3d.Manifold.cylinder(0.6, THICK, THICK, 24).rotate([0, 90, 0]).translate([0.4, 0, 0]))
    assert [found.gap for found in contacts(pin, ball)] == [0]
    assert contacts(solid_of(manifold3d.Manifold.sphere(0.1, 24).translate([0.65, 0, 0])), ball) == []


def test_a_free_end_is_a_line_of_warning_with_place_and_remedy() -> None:
    (line,) = outcome_warnings({"free_ends": [{"part": "grip", "gap": 0.4213, "position": [1.0, 20.5, -3.25]}]})
    assert all(text in line for text in ("'grip'", "0.421", "(1, 20.5, -3.25)", "region"))


def test_walls_of_a_ball_a_plate_and_a_tube() -> None:
    ball = solid_of(manifold3d.Manifold.sphere(0.5, 64))
    plate = solid_of(manifold3d.Manifold.cube([1.0, 0.03, 0.7]))
    tube = solid_of(manifold3d.Manifold.cylinder(1, 0.5, 0.5, 96) - manifold3d.Manifold.cylinder(1, 0.46, 0.46, 96))
    for solid, thick in ((ball, 1.0), (plate, 0.03), (tube, 0.04)):
        walls = measure_walls(solid)
        assert walls is not None
        assert walls.least == pytest.approx(thick, rel=0.01) and walls.thin == pytest.approx(thick, rel=0.01)
    assert measure_walls(Solid(np.zeros((0, 3)), np.zeros((0, 3)))) is None


def test_the_thinnest_place_is_found_and_what_stands_on_the_base_is_no_wall(ball: MeshDistance) -> None:
    outline = [[0, 0], [0.2, 0], [0.2, 0.1], [0.06, 0.5], [0.2, 0.9], [0.2, 1.0], [0, 1.0]]
    neck = manifold3d.Manifold.revolve(manifold3d.CrossSection([outline]), 64)
    walls = measure_walls(solid_of(neck))
    # From the waist at a right angle to its slope, to the other side's below.
    slope = np.arctan(0.14 / 0.4)
    least = 0.12 / (np.cos(slope) - np.tan(slope) * np.sin(slope))
    assert walls is not None and walls.least == pytest.approx(least, rel=0.01)
    assert abs(walls.position[2] - 0.5) < 0.01
    rod = manifold3d.Manifold.cylinder(0.7, 0.25, 0.25, 96).rotate([0, 90, 0])
    pad = manifold3d.Manifold.sphere(BASE_RADIUS + 0.01, 96) ^ rod
    post = manifold3d.Manifold.cylinder(0.5, 0.08, 0.08, 32).rotate([0, 90, 0]).translate([0.3, 0, 0])
    walls = measure_walls(solid_of(pad + post), ball)
    assert walls is not None and walls.least == pytest.approx(0.16, rel=0.02)
