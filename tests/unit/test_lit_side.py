"""Which side of the base Mitsuba shades, against renders by Mitsuba from outside."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import CASES
from pygltflib import GLTF2

from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.scene.base_appearance import base_shapes
from fd_mitsuba.scene.lit_side import ShapeShading, shaded_shapes, shading_warnings
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

INSIDE = CASES / "inside_lit_base"
SCENE = """<scene version="3.0.0"><integrator type="dual_path"><string name="prompt" value="a ball with a hat"/>
  <string name="base_prompt" value="a ball"/></integrator>{light}
  <shape type="ply" id="base"><string name="filename" value="m.ply"/>{extra}{bsdf}</shape>
  <shape type="focal_region" id="hat"><transform name="to_world"><scale value="0.3"/><translate y="0.95"/></transform>
  </shape></scene>"""
SKY = '<emitter type="constant"/>'
MATT = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.3, 0.2"/></bsdf>'
TWOSIDED = f'<bsdf type="twosided">{MATT}</bsdf>'
FLIPPED = '<boolean name="flip_normals" value="true"/>'
MIRRORED = '<transform name="to_world"><scale x="-1"/></transform>'


@pytest.fixture
def ball(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a scene with a ball; `normals` are stored in the file if given."""

    def make(
        extra: str = "",
        bsdf: str = MATT,
        light: str = SKY,
        vertices: np.ndarray | None = None,
        faces: np.ndarray | None = None,
        normals: np.ndarray | None = None,
    ) -> Path:
        sphere = unit_sphere(3)
        vertices, faces = sphere[0] if vertices is None else vertices, sphere[1] if faces is None else faces
        names = "x y z nx ny nz".split() if normals is not None else "x y z".split()
        rows = vertices if normals is None else np.concatenate([vertices, normals], axis=1)
        lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {n}" for n in names)]
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
        lines += [" ".join(f"{value:.7g}" for value in row) for row in rows]
        lines += ["3 " + " ".join(map(str, face)) for face in faces]
        (tmp_path / "m.ply").write_text("\n".join(lines) + "\n")
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(light=light, extra=extra, bsdf=bsdf))
        return path

    return make


def shading(path: Path, mi: Any) -> ShapeShading:
    scene = load_edit_scene(path)
    loaded, shapes = base_shapes(scene)
    (found,) = shaded_shapes(mi, loaded, shapes, scene.base)
    return found


def warned(path: Path, mi: Any) -> str:
    scene = load_edit_scene(path)
    loaded, shapes = base_shapes(scene)
    return "\n".join(shading_warnings(mi, loaded, shapes, scene.base))


def rendered(path: Path, mi: Any) -> np.ndarray:
    """The colour in the middle of a picture from outside."""
    loaded, _ = base_shapes(load_edit_scene(path))
    place = mi.ScalarTransform4f().look_at(origin=[0.1, 0.2, 6], target=[0.1, 0.2, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "perspective", "fov": 4, "to_world": place, "film": film})
    return np.array(mi.render(loaded, sensor=sensor, integrator=mi.load_dict({"type": "path"}), spp=64)).mean((0, 1))


def test_inward_faces_that_are_flipped_are_lit_rightly(mi: Any) -> None:
    path = INSIDE / "inv_flip" / "scene.xml"
    assert rendered(path, mi) == pytest.approx([0.65, 0.34, 0.24], abs=0.02)
    assert check_scene(load_edit_scene(path), RunConfig.load("quick")).warnings == ()


def test_a_mirrored_mesh_is_told(mi: Any) -> None:
    path = INSIDE / "mir_nonormals" / "scene.xml"
    assert rendered(path, mi) == pytest.approx([0, 0, 0], abs=1e-6)
    (warning,) = check_scene(load_edit_scene(path), RunConfig.load("quick")).warnings
    assert "base base: it is black from outside" in warning and "flip_normals" in warning


def test_the_remedies_help(tmp_path: Path, mi: Any) -> None:
    """Each of the two that the warning names makes the mirrored ball what it should be."""
    text = (INSIDE / "mir_nonormals" / "scene.xml").read_text()
    (tmp_path / "m.ply").write_bytes((INSIDE / "mir_nonormals" / "m.ply").read_bytes())
    bsdf = text[text.index("<bsdf") : text.index("</bsdf>") + 7]
    for old, new in ((bsdf, FLIPPED + bsdf), (bsdf, f'<bsdf type="twosided">{bsdf}</bsdf>')):
        path = tmp_path / "scene.xml"
        path.write_text(text.replace(old, new))
        assert rendered(path, mi) == pytest.approx([0.65, 0.34, 0.24], abs=0.02)
        assert not warned(path, mi)


@pytest.mark.parametrize("bsdf", [MATT, TWOSIDED])
@pytest.mark.parametrize("extra", ["", FLIPPED, MIRRORED, MIRRORED + FLIPPED])
@pytest.mark.parametrize("inwards", [False, True])
@pytest.mark.parametrize("stored", [None, 1.0, -1.0])
def test_told_exactly_where_a_picture_is_black(
    ball: Callable[..., Path], mi: Any, bsdf: str, extra: str, inwards: bool, stored: float | None
) -> None:
    """Winding, flipping, mirroring, stored normals and two-sidedness in all combinations."""
    vertices, faces = unit_sphere(3)
    normals = None if stored is None else stored * vertices
    path = ball(extra, bsdf, faces=faces[:, ::-1] if inwards else faces, normals=normals)
    black = rendered(path, mi).max() < 0.02
    found = shading(path, mi)
    assert found.dark == pytest.approx(1.0 if black else 0.0, abs=0.02)
    assert ("black from outside" in warned(path, mi)) == black
    if not black:
        assert found.given_back == pytest.approx(0.6, abs=0.01)


def test_partly_inverted_faces_are_measured(ball: Callable[..., Path], mi: Any) -> None:
    vertices, faces = unit_sphere(3)
    high = vertices[faces].mean(axis=1)[:, 1] > 0.5  # a cap with a quarter of the area
    turned = np.where(high[:, None], faces[:, ::-1], faces)
    path = ball('<boolean name="face_normals" value="true"/>', faces=turned)
    assert shading(path, mi).dark == pytest.approx(0.25, abs=0.03)
    assert "of its outside is black" in warned(path, mi)


def test_an_open_mesh_is_no_alarm(ball: Callable[..., Path], mi: Any) -> None:
    """A bowl of one sheet: black inside where it is looked into, but outwards is outwards."""
    vertices, faces = unit_sphere(3)
    bowl = faces[(vertices[faces].mean(axis=1)[:, 1]) < 0.6]
    assert "black" not in warned(ball(faces=bowl), mi)
    assert "black from outside" in warned(ball(faces=bowl[:, ::-1]), mi)


def test_hidden_pieces_do_not_count(ball: Callable[..., Path], mi: Any) -> None:
    """An inverted ball within the ball is never seen."""
    vertices, faces = unit_sphere(3)
    both = np.concatenate([vertices, 0.5 * vertices])
    path = ball(vertices=both, faces=np.concatenate([faces, faces[:, ::-1] + len(vertices)]))
    assert not warned(path, mi)


def test_two_sided_copies_are_told(mi: Any) -> None:
    """Every face of the head is there twice, once each way round: which is hit is a matter of luck."""
    assert "of its outside is black" in warned(CASES / "double_sided_piece" / "scene.xml", mi)


BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
THREE = '<float name="color0" value="3"/><float name="color1" value="3"/>'
BRIGHT = f'<bsdf type="diffuse"><texture type="checkerboard" name="reflectance">{THREE}</texture></bsdf>'
WITHIN = '<emitter type="point"><point name="position" x="0" y="0" z="0"/></emitter>'
BURNT = '<emitter type="constant"><rgb name="radiance" value="40"/></emitter>'


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        ({"bsdf": BLACK}, "it is all black, because its BSDF gives no light back"),
        ({"bsdf": BRIGHT}, "it gives back 3 times the light that it gets"),
        ({"light": WITHIN}, "no light of the scene reaches it"),
        ({"light": BURNT}, "times as bright as an image can show"),
        ({"light": BURNT}, "multiply its scale by 0.02"),
    ],
)
def test_all_black_and_far_above_white(ball: Callable[..., Path], mi: Any, pieces: dict[str, str], words: str) -> None:
    assert words in warned(ball(**pieces), mi)
    assert not warned(ball(), mi)


@pytest.mark.parametrize("kind", ["dielectric", "conductor", "roughconductor", "plastic", "thindielectric"])
def test_other_bsdfs_are_no_alarm(ball: Callable[..., Path], mi: Any, kind: str) -> None:
    assert not warned(ball(bsdf=f'<bsdf type="{kind}"/>'), mi)
    masked = f'<bsdf type="mask"><float name="opacity" value="0.3"/>{MATT}</bsdf>'
    assert not warned(ball(bsdf=masked), mi)


def test_a_see_through_shape_is_no_alarm(ball: Callable[..., Path], mi: Any) -> None:
    assert not warned(ball(bsdf='<bsdf type="null"/>'), mi)


def test_what_mitsuba_loads_but_cannot_render_is_one_line(tmp_path: Path) -> None:
    """In a process of its own: there, Mitsuba would trace that BSDF in every further render."""
    bump = f'<bsdf type="bumpmap"><texture type="checkerboard"/>{MATT}</bsdf>'
    for light in (SKY, ""):
        (tmp_path / "m.ply").write_bytes((CASES / "ply_uv_upside_down" / "m.ply").read_bytes())
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.format(light=light, extra="", bsdf=bump))
        command = [sys.executable, "-m", "fd_mitsuba", "check", str(path)]
        result = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert "Traceback" not in result.stderr
        told = result.stdout + result.stderr
        assert f"{path}: Mitsuba cannot shade the base: Texture::eval_1_grad(): not implemented" in told


@pytest.mark.parametrize("name", ["inv_flip", "mir_nonormals"])
def test_a_glb_shows_the_outside(tmp_path: Path, name: str) -> None:
    """glTF has no `flip_normals`, and culls faces from behind: there, outwards is what counts."""
    vertices, faces = unit_sphere(2)
    part = PartAsset(0.3 * vertices + [0, 1.2, 0], faces)
    scene = load_edit_scene(INSIDE / name / "scene.xml")
    export_assets(scene, RunConfig(), {"part": part}, tmp_path, ("glb",))
    glb = GLTF2().load(str(tmp_path / "asset.glb"))
    arrays = []
    mesh = glb.meshes[0].primitives[0]
    for number, kind in ((mesh.attributes.POSITION, np.float32), (mesh.indices, None), (mesh.attributes.NORMAL, "f4")):
        entry = glb.accessors[number]
        view = glb.bufferViews[entry.bufferView]
        kind = kind or {5123: np.uint16, 5125: np.uint32}[entry.componentType]
        width = 1 if entry.type == "SCALAR" else 3
        start = (view.byteOffset or 0) + (entry.byteOffset or 0)
        arrays.append(np.frombuffer(glb.binary_blob(), kind, entry.count * width, start).reshape(-1, 3))
    positions, corners = arrays[0].astype(float), arrays[0].astype(float)[arrays[1].astype(int)]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 1.6, rel=0.02)  # of the ellipsoid, positive: outwards
    assert (np.einsum("ij,ij->i", arrays[2], positions) >= 0).mean() > 0.99
