"""Colours, UVs and normals of mesh files, against the numbers in the files themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import CASES
from pygltflib import GLTF2

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.io.srgb import srgb_from_linear
from fd_mitsuba.scene.appearance_inputs import check_appearance_inputs
from fd_mitsuba.scene.base_appearance import base_shapes
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

COLOURS = CASES / "vertex_colours_8bit"
SCENE = """<scene version="3.0.0"><integrator type="dual_path"><string name="prompt" value="a ball with a hat"/>
  <string name="base_prompt" value="a ball"/></integrator><emitter type="constant"/>
  <shape type="ply" id="base"><string name="filename" value="m.ply"/><bsdf type="diffuse">
    <texture type="mesh_attribute" name="reflectance"><string name="name" value="{attribute}"/>{scale}</texture></bsdf>
  </shape><shape type="focal_region" id="hat"><transform name="to_world"><scale value="0.3"/>
    <translate y="1"/></transform></shape></scene>"""


def bytes_of(path: Path) -> np.ndarray:
    """(V, 3) the colours of `rgb8.ply`, read by hand."""
    data = path.read_bytes()
    row = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])
    return np.frombuffer(data, row, 1225, data.index(b"end_header\n") + 11)["colour"]


def coloured(
    folder: Path,
    kinds: str = "uchar",
    channels: str = "rgb",
    of_faces: bool = False,
    scale: str = "",
    top: float = 255,
) -> tuple[Path, np.ndarray]:
    """A ball as ASCII PLY with random colours, and these as the file has them."""
    vertices, faces = unit_sphere(2)
    rows = len(faces) if of_faces else len(vertices)
    values = np.random.default_rng(3).random((rows, len(channels))) * top
    values = np.round(values) if kinds == "uchar" else values
    fields = [f"property {kinds} {dict(r='red', g='green', b='blue', a='alpha')[c]}" for c in channels]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property float {c}" for c in "xyz")]
    lines += [] if of_faces else fields
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", *(fields if of_faces else [])]
    text = [" ".join(f"{value:g}" for value in row) for row in values]
    positions = [" ".join(f"{value:.9g}" for value in row) for row in vertices]
    corners = ["3 " + " ".join(map(str, face)) for face in faces]
    if of_faces:
        corners = [f"{face} {colour}" for face, colour in zip(corners, text, strict=True)]
    else:
        positions = [f"{place} {colour}" for place, colour in zip(positions, text, strict=True)]
    (folder / "m.ply").write_text("\n".join([*lines, "end_header", *positions, *corners]) + "\n")
    attribute = "face_color" if of_faces else "vertex_color"
    path = folder / "scene.xml"
    path.write_text(SCENE.format(attribute=attribute, scale=f'<float name="scale" value="{scale}"/>' if scale else ""))
    return path, values


def albedo(scene: EditScene, face: int, mi: Any) -> np.ndarray:
    """The reflectance that Mitsuba shades a face's middle with."""
    loaded, (shape,) = base_shapes(scene)
    mesh = scene.base[0]
    corners = mesh.vertices[mesh.faces[face]]
    middle = corners.mean(axis=0)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    ray = mi.Ray3f((middle + 0.01 * normal).tolist(), (-normal).tolist())
    surface = loaded.ray_intersect(ray)
    return np.array(shape.bsdf().eval_diffuse_reflectance(surface)).ravel()


def attribute_of(scene: EditScene, mi: Any, name: str = "vertex_color") -> np.ndarray:
    loaded, (shape,) = base_shapes(scene)
    return np.array(mi.traverse(shape)[name])


def exported(scene: EditScene, folder: Path) -> Path:
    vertices, faces = unit_sphere(2)
    part = PartAsset(0.3 * vertices + [0, 1.2, 0], faces)
    export_assets(scene, RunConfig(), {"part": part}, folder, texture_size=64)
    return folder


def accessor(path: Path, name: str, of_mesh: int = 0) -> np.ndarray:
    """An attribute of a GLB's mesh by another library."""
    glb = GLTF2().load(str(path))
    entry = glb.accessors[getattr(glb.meshes[of_mesh].primitives[0].attributes, name)]
    view = glb.bufferViews[entry.bufferView]
    width = {"VEC2": 2, "VEC3": 3, "VEC4": 4}[entry.type]
    start = (view.byteOffset or 0) + (entry.byteOffset or 0)
    values = np.frombuffer(glb.binary_blob(), np.float32, entry.count * width, start)
    return values.reshape(-1, width)


def test_bytes_are_fractions_in_render_glb_and_obj(tmp_path: Path, mi: Any) -> None:
    scene, right = load_edit_scene(COLOURS / "rgb8.xml"), bytes_of(COLOURS / "rgb8.ply") / 255
    assert scene.warnings == ()
    np.testing.assert_allclose(attribute_of(scene, mi).reshape(-1, 3), right, atol=1e-6)
    check_appearance_inputs(scene)
    folder = exported(scene, tmp_path)
    np.testing.assert_allclose(accessor(folder / "asset.glb", "COLOR_0")[:, :3], right, atol=1e-6)
    lines = [line.split() for line in (folder / "obj/asset.obj").read_text().splitlines() if line.startswith("v ")]
    found = np.array([line[4:] for line in lines if len(line) == 7], dtype=float)
    np.testing.assert_allclose(found, srgb_from_linear(right), atol=1e-6)


def test_an_exported_scene_renders_alike_without_us(tmp_path: Path, mi: Any) -> None:
    """The same ball with bytes and with fractions, exported and rendered by Mitsuba alone."""
    means = []
    for name in ("rgb8", "rgb_float_ok"):
        folder = exported(load_edit_scene(COLOURS / f"{name}.xml"), tmp_path / name)
        loaded = mi.load_file(str(folder / "mitsuba" / "scene.xml"))
        means.append(np.array(mi.render(loaded, spp=8)).mean(axis=(0, 1)))
    assert means[0] == pytest.approx(means[1], abs=1e-4) and 0.01 < means[0][0] < 1
    assert (tmp_path / "rgb8/base/rgb8.ply").read_bytes() == (COLOURS / "rgb8.ply").read_bytes()
    copied = tmp_path / "rgb_float_ok/mitsuba/files/rgb_float_ok.ply"
    assert copied.read_bytes() == (COLOURS / "rgb_float_ok.ply").read_bytes()


@pytest.mark.parametrize("channels", ["rgb", "rgba"])
@pytest.mark.parametrize("of_faces", [False, True])
def test_every_way_to_store_bytes(tmp_path: Path, mi: Any, channels: str, of_faces: bool) -> None:
    path, values = coloured(tmp_path, channels=channels, of_faces=of_faces)
    scene = load_edit_scene(path)
    face, attribute = 17, "face_color" if of_faces else "vertex_color"
    rows = values[face] if of_faces else values[scene.base[0].faces[face]].mean(axis=0)
    assert albedo(scene, face, mi) == pytest.approx(rows[:3] / 255, abs=2e-3)
    assert not check_appearance_inputs(scene)
    # Random alpha means something that cannot be kept.
    assert [line.partition(": m.ply: ")[2] for line in scene.warnings] == (
        [f"the alpha of {attribute} is left out; use a mask for what is to be see-through"] if "a" in channels else []
    )
    glb = exported(scene, tmp_path / "out") / "asset.glb"
    found = accessor(glb, "COLOR_0")[:, :3]
    right = np.repeat(values[:, :3], 3, axis=0) / 255 if of_faces else values[:, :3] / 255
    np.testing.assert_allclose(found, right, atol=1e-6)
    # What plain Mitsuba reads of the exported scene is the same once more.
    again = mi.load_file(str(tmp_path / "out/mitsuba/scene.xml")).shapes()[0]
    stored = np.array(mi.traverse(again)["face_color" if of_faces else "vertex_color"]).reshape(-1, 3)
    np.testing.assert_allclose(stored, values[:, :3] / 255, atol=1e-6)


def test_a_scale_that_expects_bytes_is_kept(tmp_path: Path, mi: Any) -> None:
    path, values = coloured(tmp_path, scale="0.00392156862745098")
    scene = load_edit_scene(path)
    face = 40
    right = values[scene.base[0].faces[face]].mean(axis=0) / 255
    assert albedo(scene, face, mi) == pytest.approx(right, abs=2e-3)
    glb = exported(scene, tmp_path / "out") / "asset.glb"
    np.testing.assert_allclose(accessor(glb, "COLOR_0")[:, :3], values / 255, atol=1e-6)


def test_a_scale_counts_in_exports(tmp_path: Path) -> None:
    path, values = coloured(tmp_path, kinds="float", top=0.4, scale="2")
    folder = exported(load_edit_scene(path), tmp_path / "out")
    np.testing.assert_allclose(accessor(folder / "asset.glb", "COLOR_0")[:, :3], 2 * values, atol=1e-5)


def test_colours_above_one_are_refused(tmp_path: Path) -> None:
    path, _ = coloured(tmp_path, kinds="float", top=255)
    with pytest.raises(UserError, match=r"id=\"base\">: reflectance reads vertex_color, .* between 0 and 1"):
        check_appearance_inputs(load_edit_scene(path))


def test_a_picture_above_one_is_refused(tmp_path: Path, mi: Any) -> None:
    values = np.full((8, 8, 3), 3.5, dtype=np.float32)
    path = CASES / "nan_uv_in_glb"
    for name in ("m.ply", "scene.xml"):
        text = (path / name).read_bytes().replace(b"tex.png", b"tex.exr")
        (tmp_path / name).write_bytes(text)
    with file_threads():
        mi.Bitmap(values).write(str(tmp_path / "tex.exr"))
    with pytest.raises(UserError, match=r"base_color reads tex.exr, whose values go up to 3.5"):
        check_appearance_inputs(load_edit_scene(tmp_path / "scene.xml"))
    values[:] = 0.5
    values[0, 0] = 1.2  # an overshoot of a resampling filter
    values = np.tile(values, (4, 4, 1))
    values[:16] = np.minimum(values[:16], 1)
    values[:, :24] = np.minimum(values[:, :24], 1)
    with file_threads():
        mi.Bitmap(values).write(str(tmp_path / "tex.exr"))
    assert "clamp them to 1" in "".join(check_appearance_inputs(load_edit_scene(tmp_path / "scene.xml")))


def test_broken_colours_are_refused(tmp_path: Path) -> None:
    path, _ = coloured(tmp_path, kinds="float", top=1)
    mesh = tmp_path / "m.ply"
    lines = mesh.read_text().splitlines()
    lines[lines.index("end_header") + 5] = "0 0 1 nan 0.5 0.5"
    mesh.write_text("\n".join(lines) + "\n")
    with pytest.raises(UserError, match=r"m.ply: .*(vertex_color|NaN)"):
        load_edit_scene(path)


def test_broken_uvs_are_told_and_replaced(tmp_path: Path) -> None:
    scene = load_edit_scene(CASES / "nan_uv_in_glb/scene.xml")
    (warning,) = scene.warnings
    assert "m.ply: 1 of 1225 UVs are NaN or infinite" in warning and '<shape type="ply" id="base">' in warning
    folder = exported(scene, tmp_path)
    assert np.isfinite(accessor(folder / "asset.glb", "TEXCOORD_0")).all()
    assert "nan" not in (folder / "obj/asset.obj").read_text()


def test_broken_normals_are_told_and_replaced(mi: Any) -> None:
    scene = load_edit_scene(CASES / "nan_uv_in_glb/normals/scene.xml")
    (warning,) = scene.warnings
    assert "m.ply: 1 of 1225 normals are NaN, infinite or zero" in warning
    normals = attribute_of(scene, mi, "vertex_normals").reshape(-1, 3)
    positions = attribute_of(scene, mi, "vertex_positions").reshape(-1, 3)
    assert np.isfinite(normals).all()
    # The ball is an ellipsoid with the half-axes 1, 1, 1.6: its normals are known.
    right = positions / [1, 1, 1.6**2]
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    assert (normals * right).sum(axis=1)[100] > 0.99


def test_what_mitsuba_warns_of_reaches_the_user(tmp_path: Path) -> None:
    path, _ = coloured(tmp_path, kinds="float", top=1)
    mesh = (tmp_path / "m.ply").read_text()
    (tmp_path / "m.ply").write_text(mesh.replace("property float blue", "property float blue_x"))
    path.write_text(path.read_text().replace("mesh_attribute", "bitmap").replace("vertex_color", "x"))
    path.write_text(path.read_text().replace('<string name="name" value="x"/>', '<rgb name="color0" value="1 0 0"/>'))
    path.write_text(path.read_text().replace('"bitmap"', '"checkerboard"'))
    scene = load_edit_scene(path)
    assert any("Mitsuba: " in line and "m.ply" in line and "ignored" in line for line in scene.warnings)
    assert all("\n" not in line and ".cpp" not in line for line in scene.warnings)


def test_no_word_about_files_that_are_only_slow(make_scene: Any) -> None:
    assert load_edit_scene(make_scene()).warnings == ()  # an ASCII PLY


def test_uvs_of_a_ply_run_the_other_way(mi: Any) -> None:
    """As documented: one ball and one picture, upper half red in an OBJ and in a PLY with `flip_tex_coords`."""
    upper = {}
    for name in ("obj", "ply", "ply_flipped"):
        scene = load_edit_scene(CASES / "ply_uv_upside_down" / f"{name}.xml")
        loaded, (shape,) = base_shapes(scene)
        surface = loaded.ray_intersect(mi.Ray3f([0.1, 0.7, 5.0], [0.0, 0.0, -1.0]))
        upper[name] = np.array(shape.bsdf().eval_diffuse_reflectance(surface)).ravel()
    assert upper["obj"][0] > 0.5 > upper["obj"][1]
    assert upper["ply_flipped"] == pytest.approx(upper["obj"], abs=1e-3)
    assert upper["ply"][1] > 0.5 > upper["ply"][0]
    text = (Path(__file__).parents[2] / "docs" / "scene_format.md").read_text()
    assert "flip_tex_coords" in text and "upside down" in text
