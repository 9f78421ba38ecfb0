"""Mesh files of every format as scenes to edit: colours, UVs, places and refusals, against what was put into them."""

from __future__ import annotations

import io
import json
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from viewer_setup import glb_faults, needs_validator

import fd_mitsuba as fd
from fd_mitsuba.assets import gltf
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.export.pictures import Picture
from fd_mitsuba.export.scene_pictures import rgba_png
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.scene_copy import SceneCopy
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.studio.base_glb import only_parts

ROOT = Path(__file__).parents[2]
ASSETS = ROOT / "tests" / "data" / "assets"
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
NAMES = sorted(path.name for path in ASSETS.iterdir() if path.suffix in SUFFIXES)
sys.path.append(str(ROOT / "tools"))
import make_test_assets as made  # noqa: E402

Load = Callable[[str], EditScene]


@pytest.fixture(scope="module")
def load(tmp_path_factory: pytest.TempPathFactory) -> Load:
    """An asset's scene, imported once."""
    scenes: dict[str, EditScene] = {}

    def loaded(name: str) -> EditScene:
        if name not in scenes:
            folder = tmp_path_factory.mktemp("assets") / name
            fd.import_asset(ASSETS / name, folder, prompt="a thing with a hat", at=["top"], up="y", front="z")
            scenes[name] = load_edit_scene(folder / "scene.xml")
        return scenes[name]

    return loaded


def linear(srgb: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Of sRGB in bytes."""
    values = np.asarray(srgb, dtype=np.float64) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def colours_at(scene: EditScene, points: np.ndarray) -> np.ndarray:
    """(N, 3) base colours of the surface nearest to points (N, 3) of the scene's frame."""
    found = BaseAppearance(scene).lookup(torch.from_numpy(scene.frame.to_canonical(points)).float())
    return found.base_color.numpy()


def side_points(sides: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """The middles of the quarters of each side of the box, and the sRGB bytes that are seen there."""
    points, tints = [], []
    for normal, right, up in made.SIDES[:sides]:
        for (x, y), tint in zip(made.CORNERS, (made.RED, made.BLUE, made.YELLOW, made.GREEN), strict=True):
            points.append(np.array(normal) + 0.5 * x * np.array(right) + 0.5 * y * np.array(up))
            tints.append(tint)
    return np.array(points, dtype=np.float64), np.array(tints)


def test_the_committed_files_are_what_the_script_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(made, "FOLDER", tmp_path)
    made.main()
    for path in tmp_path.iterdir():
        same = path.read_bytes() == (ASSETS / path.name).read_bytes()
        assert same or path.name == "maps.glb", path.name  # its JPEG depends on the encoder


@pytest.mark.parametrize("name", NAMES)
def test_every_asset_is_a_scene_whose_region_touches_it(load: Load, name: str) -> None:
    scene = load(name)
    assert scene.prompt == "a thing with a hat" and scene.base_prompt == "a thing"
    assert len(scene.regions) == 1 and scene.has_light and not scene.warnings
    region = scene.regions[0]
    top = scene.base_canonical.vertices[:, 1].max()
    assert region.bounds[0][1] < top < region.bounds[1][1]  # reaches into the top, and stands out of it


@pytest.mark.parametrize(
    ("name", "sides"),
    [
        ("box.glb", 6),
        ("transformed_uv.glb", 6),
        ("mask.glb", 6),
        ("maps.glb", 6),
        ("box.obj", 4),
        ("corner_uvs.ply", 6),
    ],
)
def test_pictures_are_the_right_way_up(load: Load, name: str, sides: int) -> None:
    points, tints = side_points(sides)
    tolerance = 0.03 if name == "maps.glb" else 2e-3  # a JPEG
    assert np.allclose(colours_at(load(name), points), linear(tints), atol=tolerance)


def test_a_factor_is_multiplied_into_the_picture(load: Load) -> None:
    points, tints = side_points()
    assert np.allclose(colours_at(load("apart.gltf"), points), linear(tints) * [0.5, 1, 1], atol=0.006)


def test_a_mirrored_picture_and_a_sparse_corner(load: Load) -> None:
    scene = load("embedded.gltf")
    # UVs reach 2, where the picture comes back mirrored: the corner at UV (0.25, 0.25) of 2 is red, and so is the last.
    points = np.array([[-0.75, 0.75, 1], [0.75, 0.75, 1], [0.75, -0.75, 1], [0, 0, 1]])
    assert np.allclose(colours_at(scene, points), linear([made.RED] * 3 + [made.YELLOW]), atol=2e-3)
    assert np.isclose(scene.base[0].vertices[:, 1].max(), 1.5)


def test_colours_at_vertices(load: Load) -> None:
    scene = load("colours.glb")
    ends = colours_at(scene, np.array([[0.0, 2.1, 0], [0, -0.1, 0]]))
    assert np.allclose(ends, [[1, 0, 60 / 255], [0, 1, 60 / 255]], atol=1e-3)  # linear in a glTF
    tips = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [0, 2, 0.0]])
    expected = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], linear(np.full(3, 32768 / 257))]
    assert np.allclose(colours_at(load("sixteen.ply"), tips), expected, atol=1e-3)
    box = colours_at(load("colours.off"), np.array([[-1, -1, -1], [1, 1, 1.0]]))
    assert np.allclose(box, linear([[20, 60, 200], [220, 60, 200]]), atol=1e-3)
    star = colours_at(load("star.obj"), np.array([[0, 1, 0.3]]))
    assert np.allclose(star, linear(np.array([[255, 127.5, 51]])), atol=1e-3)


def test_nodes_are_where_trimesh_has_them(load: Load) -> None:
    ours, theirs = load("figure.glb"), trimesh.load_scene(ASSETS / "figure.glb").to_mesh()
    assert np.allclose(ours.base_soup.vertices.min(axis=0), theirs.bounds[0], atol=1e-6)
    assert np.allclose(ours.base_soup.vertices.max(axis=0), theirs.bounds[1], atol=1e-6)
    assert np.isclose(ours.base_soup.volume(), theirs.volume) and theirs.volume > 0  # a mirrored arm stays solid
    assert {mesh.name for mesh in ours.base} == {"red", "gold"}  # one shape a material
    # The figure is turned by 90 degrees about y and moved: its head at (0, 1.4, 0) is at (5, 2.4, 0).
    gold = next(mesh for mesh in ours.base if mesh.name == "gold")
    assert np.allclose(gold.vertices.mean(axis=0), [5, 2.4, 0], atol=1e-6)
    assert np.allclose(colours_at(ours, np.array([[5, 2.8, 0.0], [5, 0.1, 0]])), [[1, 0.75, 0.3], [0.8, 0.1, 0.05]])


@pytest.mark.parametrize("name", ["box.obj", "star.obj", "quads.ply", "sixteen.ply", "corner_uvs.ply", "duck.stl"])
def test_volumes_are_what_trimesh_reads(name: str) -> None:
    theirs = trimesh.load_mesh(ASSETS / name, process=False)
    meshes = read_asset(ASSETS / name).meshes
    ours = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in meshes])
    assert np.isclose(ours.volume, theirs.volume)
    assert name == "star.obj" or np.isclose(ours.area, theirs.area)  # whose concave faces it cuts outside of them


def test_a_concave_face_is_cut_within_its_outline() -> None:
    (mesh,) = read_asset(ASSETS / "star.obj").meshes
    front = mesh.faces[(mesh.vertices[mesh.faces][..., 2] > 0.29).all(axis=1)]
    corners = mesh.vertices[front][..., :2]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) / 2
    # Ten triangles of the middle, each with sides 1 and 0.4 and an angle of 36 degrees.
    assert (area > 0).all() and np.isclose(area.sum(), 10 * 0.5 * 1 * 0.4 * np.sin(np.pi / 5), rtol=1e-5)


def test_a_skin_is_taken_as_its_joints_have_it(load: Load) -> None:
    vertices = load("skinned.glb").base[0].vertices
    # The upper half hangs on the joint that is 1 higher than where it was bound; the node's own place does not count.
    assert np.isclose(vertices[:, 1].min(), 0) and np.isclose(vertices[:, 1].max(), 3)
    assert np.abs(vertices[:, [0, 2]]).max() < 0.51
    notes = read_asset(ASSETS / "skinned.glb").notes
    assert any("skinned" in note for note in notes) and any("animated" in note for note in notes)


def test_maps_go_to_files_with_one_channel_each(load: Load) -> None:
    folder = load("maps.glb").path.parent
    texture = _images(ASSETS / "maps.glb")
    assert (folder / "maps_base_color.jpg").read_bytes() == texture[0]
    assert (folder / "maps_normal.png").read_bytes() == texture[2]
    packed = np.asarray(Image.open(io.BytesIO(texture[1])))
    roughness = np.asarray(Image.open(folder / "maps_roughness.png"))
    assert np.array_equal(roughness, (packed[..., 1] * 0.5 + 0.5).astype(np.uint8))  # times its factor
    assert np.array_equal(np.asarray(Image.open(folder / "maps_metallic.png")), packed[..., 2])
    surface = ElementTree.parse(folder / "scene.xml").find(".//bsdf[@type='principled']")
    assert surface is not None
    values = {item.get("name"): float(item.get("value", "")) for item in surface.findall("float")}
    assert np.isclose(values["specular"], ((0.4 / 2.4) ** 2) / 0.08)  # of an index of refraction of 1.4
    assert np.isclose(values["clearcoat"], 0.8)  # a quarter of which is what glTF means


def test_alpha_becomes_a_mask(load: Load) -> None:
    root = ElementTree.parse(load("mask.glb").path).getroot()
    mask = root.find("shape/bsdf[@type='mask']")
    assert mask is not None and mask.find("bsdf[@type='twosided']") is not None
    opacity = np.asarray(Image.open(load("mask.glb").path.parent / "holes_opacity.png"))
    assert (opacity[4:, :4] == 0).all() and opacity.sum() == 48 * 255
    glass = ElementTree.parse(load("apart.gltf").path).find("shape/bsdf[@type='mask']/float[@name='opacity']")
    assert glass is not None and np.isclose(float(glass.get("value", "")), 0.4, atol=1e-3)


def test_light_and_images_lie_in_the_scenes_own_folder(load: Load) -> None:
    for name in ("box.glb", "box.obj", "corner_uvs.ply"):
        scene = load(name)
        assert {file.parent.resolve() for file in scene.files} == {scene.path.parent.resolve()}
    image = next(file for file in load("box.glb").files if file.suffix == ".png")
    assert image.read_bytes() == _images(ASSETS / "box.glb")[0]  # and is the asset's own, byte for byte


def test_which_way_it_points_is_guessed_aloud(tmp_path: Path) -> None:
    imported = fd.import_asset(ASSETS / "duck.stl", tmp_path / "duck", units="mm")
    assert any("+z for up" in line for line in imported.remarks) and any(
        "+x for its front" in line for line in imported.remarks
    )
    vertices = load_edit_scene(imported.scene).base[0].vertices
    assert np.allclose(vertices[:, 1].min(), 0) and np.allclose(vertices[:, 1].max(), 53)
    assert vertices[np.argmax(vertices[:, 2]), 1] > 35  # the beak is in front, and high
    assert load_edit_scene(imported.scene).unit == "mm"
    told = fd.import_asset(ASSETS / "duck.stl", tmp_path / "told", up="z", front="-y")
    assert not any("front" in line or "for up" in line for line in told.remarks)
    turned = load_edit_scene(told.scene).base[0].vertices
    assert np.ptp(turned[:, 0]) > np.ptp(turned[:, 2])  # its beak is at the side


@pytest.mark.parametrize("behind", [False, True])
def test_a_long_animal_carries_its_head_before_it(tmp_path: Path, behind: bool) -> None:
    """A body and a raised head, alike left and right: an OBJ says nothing of its front, a glTF does."""
    vertices, faces = unit_sphere(3)
    sign = -1.0 if behind else 1.0
    beast = np.concatenate(
        [vertices * [0.3, 0.3, 1.0] + [0, 0.6, 0], vertices * 0.25 + [0, 1.1, 0.9 * sign], vertices * [0.1, 0.3, 0.1]]
    )
    mesh = trimesh.Trimesh(beast, np.concatenate([faces + k * len(vertices) for k in range(3)]), process=False)
    for suffix, turned in ((".obj", behind), (".glb", False)):
        path = tmp_path / f"beast{suffix}"
        mesh.export(path)
        imported = fd.import_asset(path, tmp_path / f"scene{suffix}")
        assert any("takes -z for its front (its higher part is there)" in line for line in imported.remarks) == turned
        points = load_edit_scene(imported.scene, needs_region=False).base[0].vertices
        head = points[np.argmax(points[:, 1])]
        assert (head[2] > 0) == (turned or not behind)


def test_smooth_faces_keep_sharp_edges() -> None:
    from fd_mitsuba.assets.crease_normals import crease_normals

    vertices, _, _ = made.box_quads()
    _, normals, faces = crease_normals(vertices.astype(np.float64), made.box_triangles())
    assert np.allclose(normals[faces[:, 0]], np.repeat([side[0] for side in made.SIDES], 2, axis=0))
    points, ball_faces = made.ball((1, 1, 1), (0, 0, 0), 24)
    source, normals, _ = crease_normals(points.astype(np.float64), ball_faces)
    assert len(source) == len(points) and (np.einsum("ij,ij->i", normals, points[source]) > 0.995).all()


# ---- what is refused


def _glb(content: dict[str, Any], blob: bytes = b"") -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(blob)}], **content}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _triangle(**primitive: Any) -> dict[str, Any]:
    view = {"buffer": 0, "byteLength": 36}
    accessor = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    mesh = {"primitives": [{"attributes": {"POSITION": 0}, **primitive}]}
    return {"bufferViews": [view], "accessors": [accessor], "meshes": [mesh], "nodes": [{"mesh": 0}]}


def _images(path: Path) -> list[bytes]:
    """The image files in a GLB, read by hand."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    content, blob = json.loads(data[20 : 20 + size]), data[28 + size :]
    views = [content["bufferViews"][image["bufferView"]] for image in content["images"]]
    return [blob[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] for view in views]


def _bomb() -> bytes:
    """A PNG of 60000 x 60000 pixels in a few hundred bytes."""
    data = bytearray(made.encoded(made.corners_picture()))
    data[16:24] = struct.pack(">II", 60000, 60000)
    import zlib

    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    return bytes(data)


def _with_image(**image: Any) -> dict[str, Any]:
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    return _triangle(material=0) | {"materials": [material], "textures": [{"source": 0}], "images": [image]}


FLAT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
REFUSED: dict[str, tuple[str, bytes, str]] = {
    "no GLB at all": ("a.glb", b"glTF\x02\0\0\0\xff\0\0\0", "cut short"),
    "no bytes": ("a.glb", b"", "is empty; export"),
    "version 1": ("a.gltf", b'{"asset": {"version": "1.0"}}', "glTF 1.0"),
    "no JSON": ("a.gltf", b"hello", "no glTF"),
    "empty": ("a.glb", _glb({"nodes": [], "scenes": [{"nodes": []}], "scene": 0}), "is empty"),
    "only points": ("a.glb", _glb(_triangle(mode=0), FLAT), "points or lines"),
    "flat": ("a.glb", _glb(_triangle(), FLAT), "enclose no volume"),
    "buffer too short": ("a.glb", _glb(_triangle(), FLAT[:20]), "within its buffer"),
    "a circle of nodes": ("a.glb", _glb(_triangle() | {"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}, FLAT),
                          "circle"),
    "Draco": ("a.glb", _glb(_triangle() | {"extensionsUsed": ["KHR_draco_mesh_compression"]}, FLAT), "Draco"),
    "meshopt": ("a.glb", _glb(_triangle() | {"extensionsRequired": ["EXT_meshopt_compression"]}, FLAT), "meshopt"),
    "an unknown extension": ("a.glb", _glb(_triangle() | {"extensionsRequired": ["ACME_foo"]}, FLAT), "ACME_foo"),
    "an image outside": ("a.glb", _glb(_with_image(uri="../../etc/passwd"), FLAT), "outside its folder"),
    "an image by its full path": ("a.glb", _glb(_with_image(uri="/etc/passwd"), FLAT), "outside its folder"),
    "an image that is missing": ("a.glb", _glb(_with_image(uri="gone.png"), FLAT), "'gone.png' not found; keep"),
    "an image bomb": ("a.glb", _glb(_with_image(uri="bomb.png"), FLAT), "60000 x 60000"),
    "not an image": ("a.glb", _glb(_with_image(bufferView=0), FLAT), "save it as PNG"),
    "OBJ without faces": ("a.obj", b"v 0 0 0\nv 1 0 0\nl 1 2\n", "no faces"),
    "OBJ with an index too large": ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "face 1 names a position of 3"),
    "OBJ with NaN": ("a.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "NaN"),
    "PLY of points": ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
                      b"property float z\nend_header\n0 0 0\n", "only points"),
    "PLY cut short": ("a.ply", (ASSETS / "quads.ply").read_bytes()[:-10], "cut short"),
    "PLY that announces too much": ("a.ply", (ASSETS / "quads.ply").read_bytes().replace(b"face 6", b"face 600000"),
                                    "announces"),
    "STL cut short": ("a.stl", (ASSETS / "duck.stl").read_bytes()[:-7], "cut short"),
    "OFF cut short": ("a.off", b"OFF\n8 6 0\n0 0 0\n", "announces 8 vertices"),
    "an unknown format": ("a.fbx", b"Kaydara", "export it as GLB"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_taken_in_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    name, data, words = REFUSED[case]
    (tmp_path / name).write_bytes(data)
    (tmp_path / "bomb.png").write_bytes(_bomb())
    with pytest.raises(UserError, match=f"a{Path(name).suffix}: .*{words}") as refused:
        fd.import_asset(tmp_path / name, tmp_path / "out")
    assert "\n" not in str(refused.value) and not (tmp_path / "out").exists()


def test_too_many_faces_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf, "MOST_FACES", 10)
    with pytest.raises(UserError, match="million faces; decimate"):
        fd.import_asset(ASSETS / "box.glb", tmp_path / "out")


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("text")
    with pytest.raises(UserError, match="not an empty folder"):
        fd.import_asset(ASSETS / "box.glb", tmp_path)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"up": "w"}, "--up w"), ({"up": "z", "front": "z"}, "two different axes"), ({"at": ["knee"]}, "--at knee"),
     ({"size": "9"}, "--size 9"), ({"at": ["1,2"]}, "x,y,z"), ({"units": "km"}, "--units km")],
)  # fmt: skip
def test_wrong_options_are_named(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=words):
        fd.import_asset(ASSETS / "box.glb", tmp_path / "out", **options)


def test_an_image_of_an_mtl_is_never_read_from_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(made.encoded(made.corners_picture()))
    below = tmp_path / "below"
    below.mkdir()
    (below / "a.obj").write_bytes((ASSETS / "box.obj").read_bytes().replace(b"box materials", b"a"))
    (below / "a.mtl").write_text("newmtl paint\nmap_Kd ../secret.png\nnewmtl ends\n")
    notes = read_asset(below / "a.obj").notes
    assert any("'../secret.png' is not beside the OBJ" in note for note in notes)


# ---- back again


@pytest.fixture(scope="module")
def returned(load: Load, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """An asset's scene exported as GLB, with a ball as its part."""

    def export(name: str, **options: Any) -> Path:
        scene, folder = load(name), tmp_path_factory.mktemp("returned")
        vertices, faces = made.ball((0.1, 0.1, 0.1), (0, 0, 0), 6)
        part = PartAsset(vertices / scene.frame.scale + scene.frame.to_user(scene.regions[0].centre), faces)
        export_assets(scene, RunConfig(), {"part": part}, folder, [Choice.of("glb", options)], 64)
        return folder / "asset.glb"

    return export


@pytest.mark.parametrize("name", ["box.glb", "colours.glb", "maps.glb"])
def test_a_glb_comes_back_with_the_numbers_it_had(name: str, returned: Callable[[str], Path]) -> None:
    path = returned(name)
    before, after = read_asset(ASSETS / name).meshes[0], read_asset(path).meshes[0]
    assert np.array_equal(before.vertices, after.vertices) and np.array_equal(before.faces, after.faces)
    assert np.array_equal(before.to_asset, after.to_asset) and np.array_equal(before.uvs.get(0), after.uvs.get(0))
    assert (before.normals is None) == (after.normals is None)
    if before.colours is not None:
        assert np.allclose(before.colours, after.colours, atol=1e-7)
    if name != "colours.glb":
        assert _images(ASSETS / name)[0] in _images(path)  # the same file, byte for byte


def test_alpha_and_transforms_of_uvs_come_back(returned: Callable[..., Path]) -> None:
    for name in ("mask.glb", "apart.gltf", "transformed_uv.glb"):
        before, after = (read_asset(path).materials[0] for path in (ASSETS / name, returned(name)))
        assert (before.alpha_mode, before.double_sided) == (after.alpha_mode, after.double_sided)
        assert np.isclose(before.opacity, after.opacity, atol=1e-3)
        assert before.base_texture is not None and after.base_texture is not None
        assert np.allclose(before.base_texture.to_uv, after.base_texture.to_uv, atol=1e-6)
        if name != "apart.gltf":  # whose colours were multiplied into its picture
            assert before.base_texture.image.data == after.base_texture.image.data


def test_a_picture_gets_its_opacity_as_alpha() -> None:
    """Where the two come from different files: of half the size, and neither 0 nor 1 alone."""
    red = Picture("red", made.encoded(Image.new("RGB", (4, 4), made.RED)))
    whole = Image.open(io.BytesIO(rgba_png(red.pixels(), np.array([[0, 255], [128, 64]], np.uint8))))
    assert whole.mode == "RGBA" and whole.size == (4, 4)
    assert np.array_equal(np.asarray(whole)[::2, ::2, 3], [[0, 255], [128, 64]])
    assert (np.asarray(whole)[..., :3] == made.RED).all()


def test_a_glb_is_in_metres_and_turns_parts_about_their_joint(
    load: Load, returned: Callable[..., Path], tmp_path: Path
) -> None:
    scene = load("figure.glb")
    assert scene.unit == "m"
    plain, small = read_asset(returned("figure.glb")), read_asset(returned("figure.glb", unit="cm", pivot=True))
    for one, other in zip(plain.meshes, small.meshes, strict=True):
        assert np.allclose(0.01 * one.placed()[0], other.placed()[0], atol=1e-7)
    shown = only_parts(returned("figure.glb", unit="cm").read_bytes(), ["part"])  # as the studio shows it
    (tmp_path / "shown.glb").write_bytes(shown)
    (alone,) = read_asset(tmp_path / "shown.glb").meshes
    assert np.allclose(alone.placed()[0], plain.meshes[-1].placed()[0], atol=1e-6)
    part = small.meshes[-1]
    centre = scene.frame.to_user(scene.regions[0].centre)
    pivot = part.to_asset[:3, 3] / 0.01
    # The ball floats above the head of the figure: its joint is the nearest point of that.
    assert part.name == "part_part" and np.allclose(pivot[[0, 2]], centre[[0, 2]], atol=0.05) and pivot[1] < centre[1]


def test_a_second_round_knows_the_unit_of_the_first(tmp_path: Path) -> None:
    imported = fd.import_asset(ASSETS / "star.obj", tmp_path / "star", units="cm", prompt="a star with a hat")
    scene = load_edit_scene(imported.scene)
    vertices, faces = made.ball((0.2, 0.2, 0.2), (0, 1, 0), 6)
    export_assets(scene, RunConfig(), {"part": PartAsset(vertices, faces)}, tmp_path / "first", ["mitsuba"], 64)
    exported = tmp_path / "first" / "mitsuba" / "scene.xml"
    assert "unit" not in exported.read_text()  # for stock Mitsuba
    again = load_edit_scene(exported, prompt="a star with a horn", needs_region=False)
    assert again.unit == "cm"
    copied = SceneCopy.of(again)  # what a run, or the studio, keeps of it
    for place, source in copied.files.items():
        (tmp_path / "copy" / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "copy" / place).write_bytes(source.read_bytes())
    kept = load_edit_scene(tmp_path / "copy" / copied.scene, prompt="a star with a horn", needs_region=False)
    export_assets(kept, RunConfig(), {"part_2": PartAsset(vertices + 0.1, faces)}, tmp_path / "second", ["glb"], 64)
    metres = [mesh.placed()[0] for mesh in read_asset(tmp_path / "second" / "asset.glb").meshes]
    assert np.allclose(np.ptp(metres[0], axis=0), 0.01 * np.ptp(scene.base[0].vertices, axis=0), rtol=1e-5)
    record = exported.with_name("stack.json")
    record.write_text(record.read_text().replace('"cm"', '"inch"'))
    with pytest.raises(UserError, match="stack.json: is damaged"):
        load_edit_scene(exported, prompt="a star with a horn", needs_region=False)


def test_a_print_is_one_watertight_solid_in_millimetres(load: Load, tmp_path: Path) -> None:
    scene = load("box.glb")
    vertices, faces = made.ball((1, 1, 1), (0, 1, 0), 24)  # half of it is in the box, whose top is at 1
    part = PartAsset(vertices.astype(np.float64), faces)
    export_assets(scene, RunConfig(), {"part": part}, tmp_path, ["print"], 64)
    solid = trimesh.load_mesh(tmp_path / "print" / "asset.stl")
    ball = trimesh.Trimesh(vertices, faces).volume
    assert solid.is_watertight and np.isclose(solid.volume, (8 + ball / 2) * 1e9, rtol=1e-3)  # of metres
    assert np.allclose(solid.bounds, [[-1000, -1000, -1000], [1000, 1000, 2000]], atol=0.1)  # z upwards
    with zipfile.ZipFile(tmp_path / "print" / "asset.3mf") as archive:
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    space = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    assert model.get("unit") == "millimeter"
    points = np.array([[float(item.get(axis, "")) for axis in "xyz"] for item in model.findall(".//m:vertex", space)])
    corners = [[int(item.get(key, "")) for key in ("v1", "v2", "v3")] for item in model.findall(".//m:triangle", space)]
    assert np.isclose(trimesh.Trimesh(points, corners).volume, solid.volume, rtol=1e-6)


def test_what_is_printed_is_closed(load: Load, tmp_path: Path) -> None:
    vertices, faces = made.ball((0.2, 0.2, 0.2), (0, 1, 0), 6)
    part = {"part": PartAsset(vertices.astype(np.float64), faces)}
    export_assets(load("box.obj"), RunConfig(), part, tmp_path, ["print"], 64)  # two shapes, each of which is open
    assert trimesh.load_mesh(tmp_path / "print" / "asset.stl").is_watertight
    (tmp_path / "hole.obj").write_bytes((ASSETS / "star.obj").read_bytes().replace(b"f 1 11 12 2", b""))
    scene = fd.load_scene(fd.import_asset(tmp_path / "hole.obj", tmp_path / "hole").scene)
    with pytest.raises(UserError, match="not closed .4 boundary edges.*assembled.ply"):
        export_assets(scene, RunConfig(), part, tmp_path / "out", ["print"], 64)


def test_an_exported_glb_is_an_asset_whose_parts_are_base(returned: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_edit_scene(fd.import_asset(returned("figure.glb"), tmp_path / "again").scene)
    assert {mesh.name for mesh in scene.base} == {"red", "gold", "base_part_part"} and not scene.earlier


@needs_validator
def test_what_was_imported_is_exported_without_a_fault(returned: Callable[..., Path]) -> None:
    names = ("figure.glb", "colours.glb", "maps.glb", "mask.glb", "apart.gltf")
    assert not glb_faults(*map(returned, names), returned("transformed_uv.glb", unit="mm", pivot=True))


@needs_validator
def test_the_assets_themselves_are_sound() -> None:
    faults = glb_faults(*(ASSETS / name for name in NAMES if name.endswith("lb") or name == "embedded.gltf"))
    assert not any(report["errors"] for report in faults.values())


def test_a_byte_order_mark_hides_no_line(tmp_path: Path) -> None:
    """Editors of Windows put one before the first line, which names the materials, or holds the first vertex."""
    mark, plain = b"\xef\xbb\xbf", (ASSETS / "star.obj").read_bytes()
    vertex = plain[plain.index(b"\nv ") + 1 :]
    (tmp_path / "plain.obj").write_bytes(vertex)
    (tmp_path / "marked.obj").write_bytes(mark + vertex.replace(b"\n", b"\r\n"))
    before, after = (read_asset(tmp_path / name).meshes for name in ("plain.obj", "marked.obj"))
    for one, other in zip(before, after, strict=True):
        assert np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces)
    (tmp_path / "red.mtl").write_bytes(mark + b"newmtl red\r\nKd 1 0 0\r\n")
    (tmp_path / "red.obj").write_bytes(mark + b"mtllib red.mtl\r\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n")
    asset = read_asset(tmp_path / "red.obj")
    assert asset.materials[asset.meshes[0].material].base_color == pytest.approx((1, 0, 0)) and not asset.notes
