"""Meshes as other programs write them by default: read, or one line with the cause and what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import CASES

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.appearance_inputs import check_appearance_inputs
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.mesh_diagnosis import mesh_fault, obj_concave_face

Make = Callable[..., Path]


@pytest.mark.parametrize(
    ("name", "cause", "remedy"),
    [
        ("plyquads", "m.ply: 240 of its 288 faces are no triangles (face 24 has 4 corners)", "triangulate"),
        ("plyquadsbin", "m.ply: 240 of its 288 faces are no triangles (face 24 has 4 corners)", "triangulate"),
        ("plyconcave", "m.ply: 8 of its 8 faces are no triangles (face 0 has 6 corners)", "triangulate"),
        ("plywedge", "UVs of their own at each corner", "PerVertex UV"),
        ("objneg", "negative vertex indices", "positive"),
        ("objvn0", "m.obj: 3 of its normals have no length", "recompute the normals"),
        ("t_cmyk", "t.jpg", "as RGB"),
        ("objvc", "OBJ reader leaves out the colours", "as PLY"),
    ],
)
def test_cause_and_remedy(name: str, cause: str, remedy: str) -> None:
    path = CASES / "mesh_reader_messages" / name / "scene.xml"
    with pytest.raises(UserError) as caught:
        check_appearance_inputs(load_edit_scene(path))
    message = str(caught.value)
    assert cause in message and remedy in message.partition(";")[2], message
    assert f"{path}:5: <" in message and ".cpp" not in message


CORNERS = [(1.5, 0, 0.5), (1.5, 0, 0), (0, 0, 0), (0, 0, -1.5), (-0.5, 0, -1.5), (-0.5, 0, 0.5)]


def prism(path: Path, start: int) -> Path:
    """An L-shaped prism with two hexagons that begin at the corner `start`."""
    lines = [f"v {x} {y} {z}" for y in (-0.6, 0.6) for x, _, z in CORNERS]
    turn = [(start + i) % 6 for i in range(6)]
    lines += ["f " + " ".join(str(i + 1) for i in reversed(turn)), "f " + " ".join(str(i + 7) for i in turn)]
    lines += [f"f {i + 1} {(i + 1) % 6 + 1} {(i + 1) % 6 + 7} {i + 7}" for i in range(6)]
    path.write_text("\n".join(lines) + "\n")
    return path


def area(path: Path, mi: object) -> float:
    """Of the two hexagons' triangles as Mitsuba makes them."""
    mesh = mi.load_dict({"type": "obj", "filename": str(path)})  # type: ignore[attr-defined]
    parameters = mi.traverse(mesh)  # type: ignore[attr-defined]
    vertices = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    corners = vertices[np.array(parameters["faces"]).reshape(-1, 3)[:8]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(normals, axis=1).sum() / 2)


def test_concave_faces_of_an_obj(tmp_path: Path, mi: object) -> None:
    """The hexagon has the area 1.75; told exactly where Mitsuba's triangles have another one."""
    for start in range(6):
        path = prism(tmp_path / "m.obj", start)
        wrong = abs(area(path, mi) - 2 * 1.75) > 1e-3
        assert (obj_concave_face(path) is not None) == wrong, start


def test_what_stands_beside_faces_is_no_matter(tmp_path: Path) -> None:
    path = prism(tmp_path / "m.obj", 0)
    path.write_text(path.read_text().replace("f 7 8", "f 7 8 # ", 1) + "f 1 2 3 4 seven\n# end\n")
    assert obj_concave_face(path) is None
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/ 2/ 3/ 4/ # a square\n")
    assert obj_concave_face(path) is None


def test_a_concave_base_is_refused(make_scene: Make, tmp_path: Path) -> None:
    path = make_scene(base='<shape type="obj" id="body"><string name="filename" value="m.obj"/></shape>')
    prism(tmp_path / "m.obj", 0)
    with pytest.raises(UserError, match="m.obj: face 2 is not convex.*triangulate"):
        load_edit_scene(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n", "header is damaged"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "only points"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nelement face 1\n"
            "property list uchar int corners\nend_header\n0\n3 0 0 0\n",
            "no vertex_index",
        ),
    ],
)
def test_further_plys(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "m.ply").write_text(text)
    assert words in (mesh_fault(tmp_path / "m.ply") or "")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "position is NaN"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "names vertex 4 of 3"),
        ("v 0 0 0\nv 1 0 0\nl 1 2\n", "no faces"),
    ],
)
def test_further_objs(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "m.obj").write_text(text)
    assert words in (mesh_fault(tmp_path / "m.obj") or "")


def test_sound_files_have_no_fault() -> None:
    for name in ("ply_uv_upside_down/m.ply", "ply_uv_upside_down/m.obj", "vertex_colours_8bit/rgb8.ply"):
        assert mesh_fault(CASES / name) is None
