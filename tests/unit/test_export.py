"""Exports: PLY files that others read, and a base that keeps its bytes."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import BASE, write_ply

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.meshes import copy_base, write_mesh
from fd_mitsuba.io.ply import ply_bytes
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]
SHIFTED = BASE.replace(
    "<bsdf", '<transform name="to_world"><scale value="3"/><translate x="5" y="1"/></transform><bsdf'
)


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.load(path, process=False)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_ply_is_read_by_trimesh_and_mitsuba(tmp_path: Path, mi: Any) -> None:
    vertices, faces = unit_sphere(2)
    path = tmp_path / "ball.ply"
    path.write_bytes(ply_bytes(vertices, faces))
    got_vertices, got_faces = read(path)
    assert np.array_equal(got_vertices, vertices.astype(np.float32)) and np.array_equal(got_faces, faces)
    parameters = mi.traverse(mi.load_dict({"type": "ply", "filename": str(path), "face_normals": True}))
    assert np.array_equal(np.array(parameters["vertex_positions"]), vertices.astype(np.float32).ravel())
    assert np.array_equal(np.array(parameters["faces"]), faces.ravel())


def test_empty_ply(tmp_path: Path) -> None:
    data = ply_bytes(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert data.startswith(b"ply\n") and data.endswith(b"end_header\n")


def test_mesh_comes_out_in_the_users_frame(make_scene: Make, tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene(base=SHIFTED, region=_region_near_shifted()))
    canonical = scene.base_canonical
    write_mesh(tmp_path / "out" / "all.ply", canonical.vertices, canonical.faces, scene)
    vertices, faces = read(tmp_path / "out" / "all.ply")
    assert np.allclose(vertices, scene.base_soup.vertices, atol=1e-5) and np.array_equal(faces, canonical.faces)
    assert abs(vertices.mean(axis=0)[0] - 5) < 0.5


def _region_near_shifted() -> str:
    return """<shape type="focal_region" id="wing"><transform name="to_world">
      <scale value="0.6"/><translate x="5" y="2"/></transform></shape>"""


def test_base_keeps_its_bytes(make_scene: Make, tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene())
    assert copy_base(scene, tmp_path / "out") is True
    assert (tmp_path / "out" / "animal.ply").read_bytes() == (tmp_path / "animal.ply").read_bytes()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["animal.ply"]
    assert copy_base(scene, tmp_path / "out") is True  # a resumed run exports again


def test_one_file_used_twice_is_copied_once(make_scene: Make, tmp_path: Path) -> None:
    again = BASE.replace('id="body"', 'id="again"').replace(
        "<bsdf", '<transform name="to_world"><translate z="0.4"/></transform><bsdf'
    )
    copy_base(load_edit_scene(make_scene(base=BASE + again)), tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["animal.ply"]


def test_files_of_the_same_name_keep_both(make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    vertices, faces = unit_sphere(2)
    write_ply(tmp_path / "more" / "animal.ply", vertices * 0.2, faces)
    more = '<shape type="ply" id="ball"><string name="filename" value="more/animal.ply"/></shape>'
    assert copy_base(load_edit_scene(make_scene(base=BASE + more)), tmp_path / "out")
    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == ["animal.ply", "ball_animal.ply"]
    assert (out / "ball_animal.ply").read_bytes() == (tmp_path / "more" / "animal.ply").read_bytes()
    assert (out / "animal.ply").read_bytes() == (tmp_path / "animal.ply").read_bytes()


def test_analytic_shapes_are_written_as_triangles(make_scene: Make, tmp_path: Path) -> None:
    balls = '<shape type="sphere"><float name="radius" value="0.5"/></shape>'
    balls += '<shape type="sphere"><float name="radius" value="0.3"/></shape>'
    balls += '<shape type="cube" id="animal"><transform name="to_world"><scale value="0.2"/></transform></shape>'
    scene = load_edit_scene(make_scene(base=BASE + balls))
    assert copy_base(scene, tmp_path / "out")
    files = {path.name: path for path in (tmp_path / "out").iterdir()}
    assert len(files) == 4  # two spheres without an id, and a cube with the name of a file: nothing is lost
    assert files["animal.ply"].read_bytes() == (tmp_path / "animal.ply").read_bytes()
    reach = sorted(float(np.abs(read(path)[0]).max()) for name, path in files.items() if name != "animal.ply")
    assert reach == pytest.approx([0.2, 0.3, 0.5], abs=1e-3)


def test_id_that_is_no_file_name(make_scene: Make, tmp_path: Path) -> None:
    scene = load_edit_scene(
        make_scene(base='<shape type="sphere" id="../a b"><float name="radius" value="0.5"/></shape>')
    )
    copy_base(scene, tmp_path / "deep" / "out")
    assert len(list((tmp_path / "deep" / "out").iterdir())) == 1
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["out"]


def test_failures_are_one_line(make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_edit_scene(make_scene())
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        copy_base(scene, tmp_path / "file" / "below")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(UserError, match="No space left"):
            copy_base(scene, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []
    (tmp_path / "animal.ply").unlink()
    with pytest.raises(UserError, match="animal.ply: cannot be read any more"):
        copy_base(scene, tmp_path / "out")
