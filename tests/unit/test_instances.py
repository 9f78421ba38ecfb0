"""Placements of an exported part: matrices by hand, the scene in stock Mitsuba, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import write_ply

from fd_mitsuba.cli.main import main
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.instances import anchored, read_placements, write_instances
from fd_mitsuba.scene.tessellate import unit_sphere

ANCHOR = {"position": [1.0, 2.0, 3.0], "direction": [0.0, 1.0, 0.0]}
RECORD = {"format": 1, "parts": {"hat": {"file": "part_hat.ply", "anchor": ANCHOR}}}
SCENE = """<?xml version='1.0' encoding='utf-8'?>
<scene version="3.0.0">
  <integrator type="path"/>
  <emitter type="constant"/>
  <sensor type="perspective"><transform name="to_world"><lookat origin="0,0,20" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>
  <shape type="ply" id="base"><string name="filename" value="files/ball.ply"/><bsdf type="diffuse"/></shape>
  <shape type="ply" id="part_hat"><string name="filename" value="files/hat.ply"/><bsdf type="conductor"/></shape>
</scene>
"""


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """A run folder as `export` leaves it: a ball of radius 1 at the origin, and a part of radius 0.5 at (1, 2.5, 3)."""
    files = tmp_path / "run" / "export" / "mitsuba" / "files"
    files.mkdir(parents=True)
    vertices, faces = unit_sphere(2)
    write_ply(files / "ball.ply", vertices, faces)
    write_ply(files / "hat.ply", vertices * 0.5 + np.array([1.0, 2.5, 3.0]), faces)
    (files.parent / "scene.xml").write_text(SCENE)
    (files.parent.parent / "part.json").write_text(json.dumps(RECORD))
    return tmp_path / "run"


def placements(folder: Path, entries: Any) -> Path:
    path = folder / "places.json"
    path.write_text(entries if isinstance(entries, str) else json.dumps(entries))
    return path


def moved(matrix: np.ndarray, *point: float) -> np.ndarray:
    return matrix[:3, :3] @ np.array(point) + matrix[:3, 3]


def test_the_anchor_goes_where_it_is_told_and_the_part_turns_with_it() -> None:
    matrix = anchored(ANCHOR, [5, 0, 0], [1, 0, 0], 0.0, 2.0)
    assert np.allclose(moved(matrix, 1, 2, 3), [5, 0, 0])
    assert np.allclose(moved(matrix, 1, 3, 3), [7, 0, 0])  # up becomes +x, twice as far
    assert np.allclose(moved(matrix, 1, 2, 4), [5, 0, 2])  # +z is perpendicular to the turn and stays
    assert np.allclose(moved(matrix, 2, 2, 3), [5, -2, 0])


def test_twist_is_counter_clockwise_seen_from_the_tip() -> None:
    matrix = anchored(ANCHOR, [0, 0, 0], [0, 3, 0], 90.0, 1.0)
    assert np.allclose(moved(matrix, 1, 2, 4), [1, 0, 0]) and np.allclose(moved(matrix, 2, 2, 3), [0, 0, -1])


@pytest.mark.parametrize("direction", [(0, 1, 0), (0, -1, 0), (0.3, -0.5, 0.8), (-1, 1e-12, 0)])
def test_every_direction_gives_a_rotation(direction: tuple[float, ...]) -> None:
    matrix = anchored(ANCHOR, [0, 0, 0], direction, 33.0, 1.0)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3)) and np.linalg.det(matrix[:3, :3]) > 0
    assert np.allclose(matrix[:3, :3] @ [0, 1, 0], np.array(direction) / np.linalg.norm(direction))


def test_stock_mitsuba_finds_every_copy_where_it_was_put(exported: Path, tmp_path: Path, mi: Any) -> None:
    shift = np.eye(4)
    shift[:3, 3] = [-4, -2.5, -3]
    entries = [
        {"to_world": shift.tolist()},
        {"part": "hat", "position": [4, 0, 0], "scale": 2, "direction": [0, 1, 0]},
        {"position": [0, -4, 0], "direction": [0, -1, 0]},
    ]
    (path,) = write_instances(exported, placements(tmp_path, entries), "many.xml")
    assert "focal_region" not in path.read_text() and "dual_path" not in path.read_text()
    scene = mi.load_file(str(path), parallel=False)

    def depth(x: float, y: float) -> float:
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 20), mi.Vector3f(0, 0, -1)))
        return float(hit.t[0]) if hit.is_valid()[0] else np.inf

    assert depth(-3, 0) == pytest.approx(19.5, abs=0.02)  # centre (1, 2.5, 3) moved by the matrix
    assert depth(4, 1) == pytest.approx(19.0, abs=0.03)  # twice as large, half its height above the anchor
    assert depth(0, -4.5) == pytest.approx(19.5, abs=0.02)  # upside down
    assert depth(0, 0) == pytest.approx(19.0, abs=0.02)  # the base stays
    assert depth(1, 2.5) == np.inf  # the part is nowhere else


def test_the_base_can_come_along(exported: Path, tmp_path: Path, mi: Any) -> None:
    there = np.eye(4)
    there[0, 3] = 6
    entries = [{"to_world": np.eye(4).tolist(), "base": True}, {"to_world": there.tolist(), "base": True}]
    (path,) = write_instances(exported, placements(tmp_path, entries), "two.xml")
    scene = mi.load_file(str(path), parallel=False)
    for x in (0.0, 6.0):
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0, 20), mi.Vector3f(0, 0, -1)))
        assert float(hit.t[0]) == pytest.approx(19.0, abs=0.02)
    assert float(mi.render(scene, spp=4).numpy().mean()) > 0


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ("{", "not valid JSON"),
        ([], "not a list"),
        ({"part": "hat"}, "not a list"),
        ([3], "placement 1: is no object"),
        ([{"position": [0, 0, 0]}, {"place": [0, 0, 0]}], "placement 2: unknown key 'place'"),
        ([{"part": "wing", "position": [0, 0, 0]}], "'wing' is none of hat"),
        ([{"part": "hat"}], "says not where"),
        ([{"position": [0, 0, 0], "to_world": np.eye(4).tolist()}], "says not where"),
        ([{"scale": 2}], "says not where"),
        ([{"position": [0, 0]}], "position is not 3 finite numbers"),
        ([{"position": [0, 0, "x"]}], "position is not"),
        ([{"position": [0, 0, 0], "direction": [0, 0, 0]}], "direction has no length"),
        ([{"position": [0, 0, 0], "scale": 0}], "flattens"),
        ([{"position": [0, 0, 0], "scale": [1, 2]}], "scale is not a finite number"),
        ([{"position": [0, 0, 0], "base": "yes"}], "write true or false"),
        ([{"to_world": np.zeros((4, 4)).tolist()}], "not affine"),
        ([{"to_world": [[1, 2], [3]]}], "to_world is not 4 x 4"),
    ],
)
def test_bad_placements_are_one_line(tmp_path: Path, entries: Any, problem: str) -> None:
    with pytest.raises(UserError, match=problem) as caught:
        read_placements(placements(tmp_path, entries), RECORD)
    assert "places.json" in str(caught.value)


def test_the_command(exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = str(placements(tmp_path, [{"position": [0, 1, 0]}]))
    assert main(["instance", str(exported), "--transforms", places]) == 0
    assert (exported / "export" / "mitsuba" / "instances.xml").exists()
    assert main(["instance", str(exported), "--transforms", places, "-o", "../x.xml"]) == 1
    assert main(["instance", str(exported), "--transforms", places, "-o", "scene.xml"]) == 1
    assert main(["instance", str(exported), "--transforms", str(tmp_path / "none.json")]) == 1
    assert main(["instance", str(tmp_path), "--transforms", places]) == 1
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 4 and "export" in errors[-1]


def test_a_base_that_shines_stays_where_it_is(exported: Path, tmp_path: Path) -> None:
    scene = exported / "export" / "mitsuba" / "scene.xml"
    scene.write_text(SCENE.replace('<bsdf type="diffuse"/>', '<emitter type="area"/>'))
    with pytest.raises(UserError, match="light"):
        write_instances(exported, placements(tmp_path, [{"position": [0, 0, 0], "base": True}]), "a.xml")
    write_instances(exported, placements(tmp_path, [{"position": [0, 0, 0]}]), "a.xml")


def test_the_example_places_a_butterfly_on_many_stumps() -> None:
    path = Path(__file__).parents[2] / "examples" / "many" / "placements.json"
    found = read_placements(path, {"parts": {"butterfly": {"anchor": ANCHOR}}})
    assert len(found) == 7 and [place.base for place in found].count(True) == 6
    for place in found[:6]:  # turned about y and scaled alike, and standing on the ground at y = 0.9973
        linear = place.to_world[:3, :3]
        assert np.allclose(linear.T @ linear, np.eye(3) * linear[1, 1] ** 2, atol=1e-3)
        assert moved(place.to_world, 0, 0.9973, 0)[1] == pytest.approx(0.9973, abs=1e-3)
