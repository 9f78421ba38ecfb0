"""Pieces of a mesh that are there twice or cancel each other, and regions without a use."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import CASES
from conftest import write_ply

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.runs.pipeline import run
from fd_mitsuba.scene.doubled_faces import without_reversed_copies
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]


def test_a_region_on_a_two_sided_piece_is_within_the_base() -> None:
    (region,) = check_scene(load_edit_scene(CASES / "double_sided_piece/scene.xml"), RunConfig()).regions
    assert region.share_in_base == pytest.approx(0.24, abs=0.01)


def test_only_reversed_copies_go() -> None:
    vertices, faces = unit_sphere(2)
    same = np.concatenate([faces, faces[:7]])
    np.testing.assert_array_equal(without_reversed_copies(vertices, faces), faces)
    np.testing.assert_array_equal(without_reversed_copies(vertices, same), same)
    np.testing.assert_array_equal(without_reversed_copies(vertices, np.concatenate([faces, faces[:9, ::-1]])), faces)
    rolled = np.roll(faces[:9, ::-1], 1, axis=1)
    np.testing.assert_array_equal(without_reversed_copies(vertices, np.concatenate([faces, rolled])), faces)
    # Copies with vertices of their own, as exporters write them.
    both = np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    np.testing.assert_array_equal(without_reversed_copies(np.concatenate([vertices, vertices]), both), faces)


def test_inside_of_a_doubled_ball() -> None:
    vertices, faces = unit_sphere(3)
    points = np.random.default_rng(1).uniform(-1.2, 1.2, (500, 3))
    points = points[np.abs(np.linalg.norm(points, axis=1) - 1) > 0.02]
    doubled = MeshDistance(vertices, np.concatenate([faces, faces[:, ::-1]]))
    np.testing.assert_array_equal(doubled.inside(points), np.linalg.norm(points, axis=1) < 1)


def test_a_region_without_an_inside_is_refused(make_scene: Make, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="320 faces of the region's mesh are there twice.*remove the copies"):
        load_edit_scene(CASES / "region_inside_out/scene.xml")
    # A cube out and a cube in, whose sides are cut along the other diagonal: no face is there twice.
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.2
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    out = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
    back = [triangle for a, b, c, d in sides for triangle in ((b, a, d), (b, d, c))]
    write_ply(tmp_path / "region.ply", corners + [0, 0.35, 0], np.array(out + back))
    region = '<shape type="focal_region" id="wing"><string name="filename" value="region.ply"/></shape>'
    with pytest.raises(UserError, match="no volume|no inside"):
        load_edit_scene(make_scene(region=region))


BALL = """<shape type="focal_region" id="{name}"><string name="part" value="{part}"/><transform name="to_world">
  <scale value="0.08"/><translate y="{y}"/></transform></shape>"""


def test_a_region_within_the_base_is_refused(make_scene: Make, tmp_path: Path) -> None:
    within = BALL.format(name="heart", part="wing", y=0)
    for refuse in (check_scene, lambda scene, config: run(scene, config, tmp_path / "run", quiet=True)):
        with pytest.raises(UserError, match="region heart: lies wholly within the base.*move it outwards"):
            refuse(load_edit_scene(make_scene(region=within)), RunConfig())
    assert not (tmp_path / "run").exists()
    beside = BALL.format(name="fin", part="wing", y=0.27)
    found = check_scene(load_edit_scene(make_scene(region=within + beside)), RunConfig()).regions
    assert found[0].share_in_base == 1 > found[1].share_in_base  # the part is seen
    other = BALL.format(name="fin", part="fin", y=0.27)
    with pytest.raises(UserError, match="region heart: lies wholly within the base"):
        check_scene(load_edit_scene(make_scene(region=within + other)), RunConfig())


def state(vertices: np.ndarray, faces: np.ndarray, make_scene: Make, folder: Path) -> str:
    path = make_scene()
    write_ply(folder / "animal.ply", vertices, faces)
    return next(line for line in check_scene(load_edit_scene(path), RunConfig()).lines() if line.startswith("base"))


def test_open_is_said_of_what_is_open(make_scene: Make, tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = animal
    assert ", closed, " in state(vertices, faces, make_scene, tmp_path)
    assert ", open (3 boundary edges), " in state(vertices, faces[1:], make_scene, tmp_path)
    turned = np.concatenate([faces[:1, ::-1], faces[1:]])
    assert ", without holes, but 3 edges have faces that point opposite ways, " in state(
        vertices, turned, make_scene, tmp_path
    )
    lines = state(vertices, np.concatenate([faces, faces[:1]]), make_scene, tmp_path)
    assert "0 boundary edges" not in lines and "3 edges have an odd number of faces" in lines
