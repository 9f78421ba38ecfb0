"""A bite out of a textured ball, from the scene file to the exports, against closed forms and the ball itself."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import write_ply
from PIL import Image

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.appearance_outcome import render_run
from fd_mitsuba.runs.pipeline import export_run, run
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]
RADIUS, BITE, AWAY = 3.0, 1.5, 3.2
"""User units: the ball, the bite, and how far the bite's centre is from the ball's; the ball is moved to x = 5."""
SETTINGS = [
    "geometry.lambda_sds=0",
    "geometry.steps=2",
    "geometry.grid_resolution=36",
    "geometry.focal_samples=200",
    "field.offsets=false",
    "field.levels=3",
    "output.turntable_frames=2",
    "output.turntable_size=32",
    "output.picture_size=0",
]


def region(name: str = "bite", mode: str = "subtract", scale: float = BITE, y: float = AWAY, part: str = "bite") -> str:
    return f"""<shape type="focal_region" id="{name}"><string name="part" value="{part}"/>
      <string name="mode" value="{mode}"/><transform name="to_world">
      <scale value="{scale}"/><translate x="5" y="{y}"/></transform></shape>"""


@pytest.fixture
def ball(tmp_path: Path) -> str:
    """A textured ball of radius `RADIUS` about (5, 0, 0), in a file of its own frame, 2 units in radius."""
    Image.fromarray(np.full((8, 8, 3), [200, 60, 20], dtype=np.uint8)).save(tmp_path / "paint.png")
    vertices, faces = unit_sphere(4)
    uv = np.stack([0.5 + np.arctan2(vertices[:, 0], vertices[:, 2]) / 7, 0.5 - vertices[:, 1] / 2.5], axis=1)
    columns = np.concatenate([2 * vertices, vertices, uv], axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    (tmp_path / "ball.ply").write_bytes("\n".join(header).encode() + columns.tobytes() + rows.tobytes())
    return """<shape type="ply" id="ball"><string name="filename" value="ball.ply"/>
      <transform name="to_world"><rotate z="1" angle="20"/><scale value="1.5"/><translate x="5"/></transform>
      <bsdf type="principled"><texture type="bitmap" name="base_color"><string name="filename" value="paint.png"/>
      </texture></bsdf></shape>"""


@pytest.fixture
def no_turntable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves out the pictures, which take most of such a run's time."""
    monkeypatch.setattr("fd_mitsuba.runs.geometry_outcome._write_turntable", lambda *_: None)


def lens() -> float:
    volume = math.pi * (RADIUS + BITE - AWAY) ** 2
    return volume * (AWAY**2 + 2 * AWAY * (RADIUS + BITE) - 3 * (RADIUS - BITE) ** 2) / (12 * AWAY)


def read(mi: Any, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Rows of position, normal, UV (V, 8) float32 and faces (F, 3), as Mitsuba reads a PLY."""
    parameters = mi.traverse(mi.load_dict({"type": "ply", "filename": str(path)}, optimize=False))
    keys = [("vertex_positions", 3), ("vertex_normals", 3), ("vertex_texcoords", 2)]
    rows = [np.array(parameters[key], dtype=np.float32).reshape(-1, width) for key, width in keys]
    return np.concatenate(rows, axis=1), np.array(parameters["faces"]).reshape(-1, 3)


def run_of(scene: Path, folder: Path) -> dict:
    return run(
        load_edit_scene(scene),
        RunConfig.load(None, SETTINGS),
        folder,
        quiet=True,
        say=lambda line: None,
        stages=("geometry",),
    )


def triangles(rows: np.ndarray, faces: np.ndarray) -> set[bytes]:
    return {np.ascontiguousarray(triangle).tobytes() for triangle in rows[faces]}


@pytest.mark.usefixtures("no_turntable")
def test_a_bite_from_scene_to_exports(make_scene: Make, ball: str, tmp_path: Path, mi: Any) -> None:
    scene = make_scene(base=ball, region=region())
    folder = tmp_path / "run"
    metrics = run_of(scene, folder)
    assert metrics["volume_change_error"] < 1e-4 and metrics["base_identical"] and metrics["manifold"]
    assert (folder / "export" / "base" / "ball.ply").read_bytes() == (tmp_path / "ball.ply").read_bytes()
    removed = trimesh.load(folder / "export" / "part_bite.ply")
    assert removed.is_watertight and removed.volume == pytest.approx(metrics["removed_volume"], rel=0.02)
    assert metrics["removed_volume"] == pytest.approx(lens(), rel=0.02)
    whole, cut = read(mi, tmp_path / "ball.ply"), read(mi, folder / "export" / "cut_ball.ply")
    solid = trimesh.Trimesh(1.5 * cut[0][:, :3], cut[1])
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    assert solid.is_watertight
    before = trimesh.Trimesh(1.5 * whole[0][:, :3], whole[1]).volume
    assert before - solid.volume == pytest.approx(metrics["removed_volume"], rel=1e-3)
    # Away from the bite, every triangle is there as it was, position and UV bit for bit;
    # normals too, but Mitsuba normalises them anew whenever it reads a file.
    turn = np.radians(20)
    centre = AWAY / 1.5 * np.array([np.sin(turn), np.cos(turn), 0.0])
    reach = (BITE + 0.05) / 1.5
    far = np.linalg.norm(whole[0][whole[1]][..., :3] - centre, axis=2).min(axis=1) > reach
    assert 0.5 < far.mean() < 1
    exact = [0, 1, 2, 6, 7]
    assert triangles(whole[0][:, exact], whole[1][far]) <= triangles(cut[0][:, exact], cut[1])
    rounded = (np.round(whole[0], 4) + 0.0, np.round(cut[0], 4) + 0.0)
    assert len(triangles(rounded[0], whole[1][far]) - triangles(rounded[1], cut[1])) < 0.01 * far.sum()
    uv = cut[0][:, 6:]
    assert uv.min() >= whole[0][:, 6:].min() and uv.max() <= whole[0][:, 6:].max()

    written = export_run(folder, ("glb", "obj", "ply", "mitsuba"), 64, say=lambda line: None)
    assert not written["part_faces"] and "ply/cut_ball.ply" in written["files"]
    loaded = trimesh.load(folder / "export" / "asset.glb")
    assert list(loaded.geometry) == ["base"]
    shape = next(iter(mi.load_file(str(folder / "export" / "mitsuba" / "scene.xml"), parallel=False).shapes()))
    box = shape.bbox()
    assert np.isclose(box.min.y, -RADIUS, atol=0.01) and box.max.y < RADIUS - 0.05
    record = json.loads((folder / "export" / "part.json").read_text())
    assert record["parts"]["bite"]["volume"] == pytest.approx(removed.volume, rel=1e-3)


@pytest.mark.usefixtures("no_turntable")
def test_a_cap_above_the_cut_goes_with_it(make_scene: Make, ball: str, tmp_path: Path) -> None:
    """A flat region cuts a slice out just below the ball's top, whose cap nothing holds any more."""
    slice_ = region().replace(f'<scale value="{BITE}"/><translate x="5" y="{AWAY}"/>',
                              '<scale x="2.4" y="0.25" z="2.4"/><translate x="5" y="2.55"/>')  # fmt: skip
    metrics = run_of(make_scene(base=ball, region=slice_), tmp_path / "run")
    assert metrics["crumbs"] == 1 and metrics["loose_pieces"] == 0 and metrics["volume_change_error"] < 1e-3
    for name in ("cut_ball", "assembled", "part_bite"):
        mesh = trimesh.load(tmp_path / "run" / "export" / f"{name}.ply")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        assert mesh.is_watertight and mesh.body_count == 1, name
    top = trimesh.load(tmp_path / "run" / "export" / "assembled.ply").bounds[1, 1]
    assert top < 2.5


@pytest.mark.usefixtures("no_turntable")
def test_an_analytic_base_is_cut_too(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    base = '<shape type="sphere" id="ball"><point name="center" x="5" y="0" z="0"/>'
    base += '<float name="radius" value="3"/></shape>'
    folder = tmp_path / "run"
    metrics = run_of(make_scene(base=base, region=region()), folder)
    assert metrics["removed_volume"] == pytest.approx(lens(), rel=0.02)
    export_run(folder, ("mitsuba",), 64, say=lambda line: None)
    scene = mi.load_file(str(folder / "export" / "mitsuba" / "scene.xml"), parallel=False)
    box = scene.shapes()[0].bbox()
    assert np.allclose([box.min.x, box.max.x], [2, 8], atol=0.01) and box.max.y < RADIUS - 0.05


@pytest.mark.usefixtures("no_turntable")
def test_a_shape_out_of_reach_stays_and_may_be_open(make_scene: Make, tmp_path: Path, animal: Any) -> None:
    """One of two: a ball that is bitten, and far below it a sheet with holes."""
    vertices, faces = unit_sphere(4)
    write_ply(tmp_path / "open.ply", 0.5 * vertices - [0, 2.5, 0], faces[:-3])
    write_ply(tmp_path / "round.ply", vertices * RADIUS + [5, 0, 0], faces)
    base = '<shape type="ply" id="ball"><string name="filename" value="round.ply"/></shape>'
    base += '<shape type="ply" id="sheet"><string name="filename" value="open.ply"/>'
    base += '<transform name="to_world"><translate x="5" y="-1.5"/></transform></shape>'
    folder = tmp_path / "run"
    run_of(make_scene(base=base, region=region()), folder)
    assert (folder / "export" / "cut_ball.ply").is_file() and not (folder / "export" / "cut_sheet.ply").exists()


def test_the_built_in_prior_leaves_the_appearance_stage_out_with_a_remark(
    make_scene: Make, ball: str, tmp_path: Path
) -> None:
    scene, said = load_edit_scene(make_scene(base=ball, region=region())), []
    config = RunConfig.load(None, [*SETTINGS, "geometry.grid_resolution=20"])
    metrics = run(scene, config, tmp_path / "run", quiet=True, say=said.append)
    assert "appearance" not in metrics and any("only the geometry stage" in line for line in said)
    assert (tmp_path / "run" / "export" / "asset.glb").is_file()
    with pytest.raises(UserError, match=r"appearance\.lambda_sds=0"):
        run(scene, config, tmp_path / "run", quiet=True, say=said.append, stages=("appearance",))


PAINTED = [
    "appearance.lambda_sds=0",
    "appearance.style=true",
    "appearance.boundary_reach=0.5",
    "appearance.learning_rate=0.05",
    "appearance.steps=40",
    "appearance.views=1",
    "appearance.spp=2",
    "appearance.picture_size=16",
    "output.texture_size=64",
    "output.sheet_every=1000",
]


@pytest.mark.slow
@pytest.mark.usefixtures("no_turntable")
def test_the_faces_of_a_cut_learn_a_material(make_scene: Make, ball: str, tmp_path: Path, mi: Any) -> None:
    """Without guidance the style losses alone teach it, here on all of it: it takes the ball's paint."""
    part = '<bsdf type="principled" id="part"><rgb name="base_color" value="0.1, 0.2, 0.6"/></bsdf>'
    scene, folder = load_edit_scene(make_scene(base=ball, region=region(), part=part)), tmp_path / "run"
    config = RunConfig.load(None, [*SETTINGS, *PAINTED])
    metrics = run(scene, config, folder, quiet=True, say=lambda line: None)
    found = metrics["appearance"]
    assert found["base_psnr_db"] > 60 and found["mask_error"] < 1e-6 and 0 < found["untouched_share"] < 1
    assert found["mean_red"] > 0.3 > found["mean_blue"]  # from the blue of the scene file to the paint's linear 0.58
    export = folder / "export"
    # What is left of the ball and the faces of the cut are the closed cut ball, triangle for triangle.
    whole, opened = read(mi, export / "cut_ball.ply"), read(mi, export / "open_ball.ply")
    assert triangles(opened[0][:, :3], opened[1]) <= triangles(whole[0][:, :3], whole[1])
    faces = trimesh.load(export / "cut_face_bite.ply", process=False)
    assert len(faces.faces) == len(whole[1]) - len(opened[1]) > 100
    centre = np.array([5, AWAY, 0])
    assert np.abs(np.linalg.norm(faces.vertices - centre, axis=1) - BITE).max() < 0.05
    assert np.all(np.einsum("ij,ij->i", faces.face_normals, centre - faces.triangles_center) > 0)
    loaded = trimesh.load(export / "asset.glb")
    assert set(loaded.geometry) == {"base", "cut_face_bite"}
    texture = loaded.geometry["cut_face_bite"].visual.material.baseColorTexture
    assert texture.size == (64, 64) and np.asarray(texture)[..., 0].mean() > 1.5 * np.asarray(texture)[..., 2].mean()
    plain = mi.load_file(str(export / "mitsuba" / "scene.xml"), parallel=False)
    shapes = {shape.id(): shape for shape in plain.shapes()}
    assert set(shapes) == {"ball", "cut_face_bite"}
    assert np.isclose(shapes["ball"].bbox().min.y, -RADIUS, atol=0.01)
    written = export_run(folder, ("obj", "ply", "glb"), 64, say=lambda line: None)
    assert {"ply/cut_ball.ply", "ply/cut_face_bite.ply"} <= set(written["files"])
    pictures = render_run(folder, {}, "round", 1, 32, 4, 3)
    assert all(path.is_file() for path in pictures)
    # A next round takes the two for base; another bite needs a closed shape, and says so.
    exported = export / "mitsuba" / "scene.xml"
    more = tmp_path / "more.xml"
    pieces = region("ear", "add", 1.0, -3.2, "ear")
    more.write_text(f'<scene version="3.0.0">{pieces}</scene>')
    again = load_edit_scene(exported, regions=more, prompt="a ball with an ear")
    assert [mesh.name for mesh in again.base] == ["ball", "cut_face_bite"] and not again.earlier
    more.write_text(f'<scene version="3.0.0">{region("second", y=-AWAY, part="other")}</scene>')
    with pytest.raises(UserError, match="'ball' is not closed"):
        load_edit_scene(exported, regions=more, prompt="a ball with two bites")


OPEN = '<shape type="ply" id="ball"><string name="filename" value="open.ply"/></shape>'
CASES = {
    "unknown mode": ({"region": region(mode="carve")}, ("bite", "'carve'", "'add'", "'subtract'")),
    "mode not text": (
        {"region": region().replace('<string name="mode" value="subtract"/>', '<float name="mode" value="1"/>')},
        ("bite", "mode is a number, not text"),
    ),
    "both modes": (
        {"region": region() + region("ear", "add", part="ear")},
        ("ear", "'bite' subtracts", "one mode"),
    ),
    "one part, both modes": ({"region": region() + region("ear", "add")}, ("ear", "'bite'", "one mode")),
    "misses the base": ({"region": region(scale=0.3, y=3.45)}, ("bite", "does not reach the base", "move it")),
    "takes everything": ({"region": region(scale=3.05, y=0)}, ("bite", "all of the base", "shrink")),
    "a shape with the name of the cut's faces": (
        {"extra": '<shape type="sphere" id="cut_face_bite"><point name="center" x="5" y="-4" z="0"/></shape>'},
        ("bite", "'cut_face_bite'", "another part name"),
    ),
    "open base": ({"base": OPEN}, ("bite", "'ball' is not closed (", "repair")),
    "base inside out": ({"base": OPEN.replace("open", "inward")}, ("bite", "'ball'", "inwards", "flip")),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_cuts_end_in_one_line(name: str, make_scene: Make, ball: str, tmp_path: Path) -> None:
    pieces, words = CASES[name]
    vertices, faces = unit_sphere(3)
    write_ply(tmp_path / "open.ply", vertices * RADIUS + [5, 0, 0], faces[:-3])
    write_ply(tmp_path / "inward.ply", vertices * RADIUS + [5, 0, 0], faces[:, ::-1])
    with pytest.raises(UserError) as caught:
        load_edit_scene(make_scene(**{"base": ball, "region": region(), **pieces}))
    message = str(caught.value)
    assert "\n" not in message and "scene.xml" in message and all(word in message for word in words), message


def test_a_prompt_that_adds_does_not_fit_a_cut(
    make_scene: Make, ball: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = make_scene(base=ball, region=region())
    assert main(["run", str(scene), "-o", str(tmp_path / "run"), "--stage", "geometry"]) != 0
    error = capsys.readouterr().err
    assert "say what to take off" in error and "lambda_sds=0" in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()
