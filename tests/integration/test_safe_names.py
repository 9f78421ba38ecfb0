"""Names from outside become files, groups, materials and links, and lead nowhere else."""

from __future__ import annotations

import html.parser
import json
import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urljoin, urlsplit
from urllib.request import url2pathname

import numpy as np
import pytest
import trimesh
from conftest import LIGHT, write_ply
from test_export_assets import exported

from fd_mitsuba.evaluation.report.gallery import write_gallery
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.export.obj import ObjMesh, obj_files
from fd_mitsuba.export.pictures import Picture, png
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]
CASES = Path(__file__).parents[1] / "data" / "cases"
NAME = re.compile(r"\w[\w.-]*")


def files_below(folder: Path) -> list[Path]:
    return [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]


def check_obj(folder: Path) -> tuple[list[str], trimesh.Scene]:
    """Names in an OBJ and its MTL are single words, each is there, and differ where case does not count."""
    words = [
        line.split(" ") for name in ("asset.obj", "asset.mtl") for line in (folder / name).read_text().splitlines()
    ]
    for word, *rest in words:
        if word in ("o", "g", "usemtl", "newmtl", "mtllib"):
            assert len(rest) == 1 and NAME.fullmatch(rest[0]), (word, rest)
    maps = [line[-1] for line in words if line[0].startswith(("map_", "norm"))]
    for name in maps:
        assert NAME.fullmatch(name) and (folder / name).is_file(), name
    made = [line[1] for line in words if line[0] == "newmtl"]
    assert set(made) == {line[1] for line in words if line[0] == "usemtl"}
    assert len({name.lower() for name in made}) == len(made)
    return made, trimesh.load(folder / "asset.obj", force="scene")


@pytest.mark.parametrize("scene", ["shape_id_leaves_folder/scene.xml", "obj_names/scene/my scene.xml"])
def test_kept_case(scene: str, tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b" / "c" / "d" / "export"
    loaded = load_edit_scene(CASES / scene)
    written = exported(loaded, folder)
    outside = [path for path in tmp_path.rglob("*") if path.is_file() and not path.is_relative_to(folder)]
    assert not outside
    found = files_below(folder)
    assert all(NAME.fullmatch(piece) for path in found for piece in path.parts)
    assert len({str(path).lower() for path in found}) == len(found)
    assert written["base_identical"] and {Path(name) for name in written["files"]} <= set(found)
    made, read = check_obj(folder / "obj")
    assert len(made) == len(loaded.base) + 1 == len(read.geometry)
    faces = sum(len(mesh.faces) for mesh in read.geometry.values())
    assert faces == sum(len(mesh.faces) for mesh in loaded.base) + written["part_faces"]["part"]
    pictures = [mesh.visual.material.image for mesh in read.geometry.values()]
    assert sum(picture is not None for picture in pictures) == len(loaded.base)


def test_pictures_that_differ_keep_their_own(tmp_path: Path) -> None:
    """Two shapes whose names are one after cleaning, each with a picture of its own."""
    vertices, faces = unit_sphere(1)
    uv = np.zeros((len(vertices), 2))
    pictures = [png(np.full((2, 2, 3), value)) for value in (0.1, 0.9, 0.5)]
    meshes = [
        ObjMesh(name, vertices, faces, PbrMaterial(name, base_picture=Picture(f"{name}_base_color", data)), uv=uv)
        for name, data in zip(["Hat 1", "hat/1", "HAT:1"], pictures, strict=True)
    ]
    files = obj_files(meshes)
    assert [line for line in files["asset.mtl"].decode().splitlines() if "_base_color" in line] == [
        "map_Kd Hat_1_base_color.png", "map_Kd hat_1_base_color_2.png", "map_Kd HAT_1_base_color_3.png"
    ]  # fmt: skip
    assert [data for name, data in files.items() if name.endswith(".png")] == pictures


def test_an_earlier_part_with_the_name_of_a_path(make_scene: Make, tmp_path: Path) -> None:
    vertices, faces = unit_sphere(2)
    write_ply(tmp_path / "old.ply", vertices * 0.1, faces)
    old = '<shape type="ply" id="part_../../../../old one"><string name="filename" value="old.ply"/></shape>'
    folder = tmp_path / "x" / "y" / "export"
    exported(load_edit_scene(make_scene(light=LIGHT + old)), folder)
    found = files_below(folder)
    assert all(NAME.fullmatch(piece) for path in found for piece in path.parts)
    assert {path.name for path in (folder / "ply").iterdir()} == {"part_part.ply", "part_.._.._.._.._old_one.ply"}
    assert not [path for path in tmp_path.rglob("*old one*")]


def test_files_of_a_scene_with_names_that_clash(make_scene: Make, tmp_path: Path) -> None:
    vertices, faces = unit_sphere(2)
    shapes = ""
    for number, name in enumerate(["a b.ply", "A_B.ply", "a:b.ply", "a_b.PLY"]):
        write_ply(tmp_path / name, vertices * (1 + number), faces)
        shapes += f'<shape type="ply" id="s{number}"><string name="filename" value="{name}"/></shape>'
    scene = load_edit_scene(make_scene(base=shapes))
    folder = tmp_path / "export"
    assert exported(scene, folder)["base_identical"]
    for where in ("base", "mitsuba/files"):
        names = [path.name for path in (folder / where).iterdir()]
        assert len({name.lower() for name in names}) == len(names) >= 4 and all(map(NAME.fullmatch, names)), names
    copies = {path.read_bytes() for path in (folder / "mitsuba" / "files").iterdir()}
    assert {(tmp_path / name).read_bytes() for name in ("a b.ply", "A_B.ply", "a:b.ply", "a_b.PLY")} <= copies


def run_in(folder: Path) -> Path:
    """As much of a run as a gallery wants."""
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"prompt": 'a "cat" <script>alert(1)</script>', "scene": "s.xml"}))
    (folder / "report.html").write_text("<p>report</p>")
    return folder


def test_links_of_a_gallery_lead_to_the_reports(tmp_path: Path) -> None:
    names = ["javascript:alert(1)", "data:text,x", 'a" onclick="x', "50% off#1?x=1&y", "ü b", "//evil", "plain"]
    runs = [run_in(tmp_path / "runs" / name.replace("/", "_")) for name in names]
    page = write_gallery(runs, tmp_path / "runs" / "gallery.html", "<b>Runs</b>").read_text(encoding="utf-8")
    tags: list[tuple[str, dict[str, str | None]]] = []
    parser = html.parser.HTMLParser()
    parser.handle_starttag = lambda tag, attributes: tags.append((tag, dict(attributes)))  # type: ignore[method-assign]
    parser.feed(page)
    links = [attributes["href"] for tag, attributes in tags if tag == "a"]
    assert len(links) == len(names)
    for link, run in zip(links, runs, strict=True):
        whole = urlsplit(urljoin((tmp_path / "runs" / "gallery.html").as_uri(), link or ""))
        assert whole.scheme == "file" and Path(url2pathname(whole.path)) == run / "report.html"
        assert not whole.query and not whole.fragment
    assert not any("onclick" in attributes for _, attributes in tags)
    assert [tag for tag, _ in tags].count("script") == 1
