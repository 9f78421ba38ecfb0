"""Exports reloaded by other libraries and rendered by stock Mitsuba."""

from __future__ import annotations

import io
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from conftest import BASE, PART
from PIL import Image
from viewer_setup import glb_faults, needs_validator

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.assets import FORMATS, PartAsset, export_assets
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]
MOVED = '<transform name="to_world"><scale value="3"/><rotate y="1" angle="30"/><translate x="5" y="1"/></transform>'
FAR_REGION = """<shape type="focal_region" id="wing"><transform name="to_world">
      <scale value="0.6"/><translate x="5" y="2"/></transform></shape>"""


def part_of(scene: EditScene, values: Any = None) -> dict[str, PartAsset]:
    """A lumpy ball where the region is."""
    vertices, faces = unit_sphere(3)
    lumpy = vertices * (1 + 0.1 * np.sin(6 * vertices[:, :1])) * 0.25
    centre = scene.frame.to_user(np.mean([region.bounds for region in scene.regions], axis=(0, 1)))
    return {"part": PartAsset(lumpy / scene.frame.scale + centre, faces, values)}


class Learned:
    """A material for every point, as a texture field returns it."""

    def __init__(self, points: torch.Tensor, plain: bool = False) -> None:
        wave = 0.5 + 0.4 * torch.sin(6 * points)
        count = len(points)
        self.base_color = torch.tensor([[0.6, 0.3, 0.1]]).expand(count, 3) if plain else wave
        self.roughness = torch.full((count, 1), 0.5) if plain else wave[:, :1]
        self.metallic = torch.zeros(count, 1) if plain else wave[:, 1:2]
        slope = torch.zeros(count, 2) if plain else 0.3 * torch.cos(9 * points[:, :2])
        normal = torch.cat([slope, torch.ones(count, 1)], dim=1)
        self.normal = normal / normal.norm(dim=1, keepdim=True)


@pytest.fixture
def textured_base(tmp_path: Path) -> str:
    """A base with UVs and a picture that differs in all four corners; PLY, so that v runs down."""
    picture = np.zeros((32, 64, 3), dtype=np.uint8)
    picture[:16, :32], picture[:16, 32:], picture[16:, :32], picture[16:, 32:] = 40, (200, 0, 0), (0, 200, 0), 255
    Image.fromarray(picture).save(tmp_path / "paint.png")
    vertices, faces = unit_sphere(3)
    uv = np.stack([0.5 + np.arctan2(vertices[:, 0], vertices[:, 2]) / 7, 0.5 - vertices[:, 1] / 2.5], axis=1)
    rows = np.concatenate([vertices * [0.3, 0.3, 0.5], uv], axis=1)
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {n}" for n in "xyzst")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "ball.ply").write_text("\n".join(header + lines) + "\n")
    return """<shape type="ply" id="ball"><string name="filename" value="ball.ply"/><bsdf type="twosided">
      <bsdf type="principled"><texture type="bitmap" name="base_color"><string name="filename" value="paint.png"/>
      </texture><float name="roughness" value="0.35"/></bsdf></bsdf></shape>"""


def exported(scene: EditScene, folder: Path, values: Any = None, size: int = 64, **options: Any) -> dict[str, Any]:
    return export_assets(scene, RunConfig(), part_of(scene, values), folder, texture_size=size, **options)


def accessor(file: pygltflib.GLTF2, index: int) -> np.ndarray:
    item = file.accessors[index]
    view = file.bufferViews[item.bufferView]
    kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[item.componentType]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[item.type]
    assert (view.byteOffset or 0) % 4 == 0
    raw = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(raw, kind).reshape(item.count, width)


def node(file: pygltflib.GLTF2, name: str) -> tuple[pygltflib.Node, pygltflib.Primitive]:
    found = next(item for item in file.nodes if item.name == name)
    return found, file.meshes[found.mesh].primitives[0]


def picture(file: pygltflib.GLTF2, texture: int) -> bytes:
    view = file.bufferViews[file.images[file.textures[texture].source].bufferView]
    return file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]


def test_glb_holds_base_and_part_as_they_are(make_scene: Make, textured_base: str, tmp_path: Path, mi: Any) -> None:
    scene = load_edit_scene(make_scene(base=textured_base))
    result = exported(scene, tmp_path / "out", Learned)
    assert result["base_identical"]
    file = pygltflib.GLTF2().load(tmp_path / "out" / "asset.glb")
    assert [file.nodes[i].name for i in file.scenes[0].nodes] == ["base", "part_part"]
    assert file.scenes[0].extras["prompt"] == scene.prompt and file.scenes[0].extras["seed"] == 0
    _, base = node(file, "base")
    loaded = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "ball.ply")}))
    for attribute, key in (
        (base.attributes.POSITION, "vertex_positions"),
        (base.attributes.NORMAL, "vertex_normals"),
        (base.attributes.TEXCOORD_0, "vertex_texcoords"),
    ):
        assert np.array_equal(accessor(file, attribute).ravel(), np.array(loaded[key]))
    assert np.array_equal(accessor(file, base.indices).ravel(), np.array(loaded["faces"]))
    material = file.materials[base.material]
    assert material.doubleSided and material.pbrMetallicRoughness.roughnessFactor == pytest.approx(0.35)
    assert material.pbrMetallicRoughness.metallicFactor == 0
    assert picture(file, material.pbrMetallicRoughness.baseColorTexture.index) == (tmp_path / "paint.png").read_bytes()
    assert (tmp_path / "out" / "base" / "paint.png").read_bytes() == (tmp_path / "paint.png").read_bytes()
    found, part = node(file, "part_part")
    assert found.extras["part"] == "part"
    wanted = part_of(scene)["part"]
    corners = accessor(file, part.attributes.POSITION)[accessor(file, part.indices).reshape(-1, 3)]
    assert np.array_equal(corners, wanted.vertices.astype(np.float32)[wanted.faces])
    tangents, normals = (accessor(file, a) for a in (part.attributes.TANGENT, part.attributes.NORMAL))
    assert np.allclose(np.einsum("ij,ij->i", tangents[:, :3], normals), 0, atol=1e-6)
    assert set(np.unique(tangents[:, 3])) == {1.0}
    surface = file.materials[part.material].pbrMetallicRoughness
    assert surface.roughnessFactor == surface.metallicFactor == 1
    orm = np.asarray(Image.open(io.BytesIO(picture(file, surface.metallicRoughnessTexture.index))))
    rough = np.asarray(Image.open(tmp_path / "out" / "textures" / "part_part_roughness.png"))
    metal = np.asarray(Image.open(tmp_path / "out" / "textures" / "part_part_metallic.png"))
    assert np.array_equal(orm[..., 1], rough) and np.array_equal(orm[..., 2], metal)


def test_trimesh_reads_the_same_numbers(make_scene: Make, tmp_path: Path) -> None:
    moved = BASE.replace("<bsdf", f"{MOVED}<bsdf")
    scene = load_edit_scene(make_scene(base=moved, region=FAR_REGION))
    exported(scene, tmp_path / "out", Learned)
    part = part_of(scene)["part"]
    exact = part.vertices.astype(np.float32)[part.faces]
    ply = trimesh.load(tmp_path / "out" / "ply" / "part_part.ply", process=False)
    assert np.array_equal(as_floats(ply), exact)
    obj = trimesh.load(tmp_path / "out" / "obj" / "asset.obj", process=False)
    meshes = {mesh.visual.material.name: mesh for mesh in obj.geometry.values()}
    assert set(meshes) == {"base", "part_part"}
    assert np.array_equal(as_floats(meshes["part_part"]), exact)
    whole = trimesh.load(tmp_path / "out" / "asset.glb", process=False)
    turned = whole.geometry["base"].vertices @ whole.graph["base"][0][:3, :3].T + whole.graph["base"][0][:3, 3]
    assert np.allclose(turned, scene.base[0].vertices, atol=2e-6 * np.abs(scene.base[0].vertices).max())
    assert np.array_equal(as_floats(whole.geometry["part_part"]), exact)


def as_floats(mesh: trimesh.Trimesh) -> np.ndarray:
    """Corners (F, 3, 3) as float32."""
    return np.asarray(mesh.vertices, dtype=np.float32)[mesh.faces]


def test_obj_names_materials_and_maps(make_scene: Make, tmp_path: Path) -> None:
    exported(load_edit_scene(make_scene()), tmp_path / "out", Learned, formats=["obj"])
    folder = tmp_path / "out" / "obj"
    text = (folder / "asset.obj").read_text()
    assert [line for line in text.splitlines() if line[:2] == "g "] == ["g base", "g part_part"]
    material = (folder / "asset.mtl").read_text()
    for word in ("map_Kd", "map_Pr", "map_Pm", "norm"):
        line = next(line for line in material.splitlines() if line.startswith(f"{word} "))
        assert (folder / line.split()[-1]).is_file()
    # Blender makes the strength of a normal map of -bm, and takes 0 where there is none.
    assert next(line for line in material.splitlines() if line.startswith("map_Bump ")).startswith("map_Bump -bm 1 ")
    assert not (tmp_path / "out" / "asset.glb").exists()


STOCK = """
import sys, numpy as np, mitsuba as mi
mi.set_variant(sys.argv[3])
picture = mi.render(mi.load_file(sys.argv[1], parallel=False), spp=int(sys.argv[4]), seed=3)
np.save(sys.argv[2], np.array(picture))
"""


def stock_render(scene: Path, output: Path, spp: int = 64) -> np.ndarray:
    """What a Mitsuba that never heard of us makes of a scene."""
    subprocess.run([sys.executable, "-c", STOCK, str(scene), str(output), "scalar_rgb", str(spp)], check=True)
    return np.load(output)


SENSOR = """<sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
  <lookat origin="1.5, 0.9, 1.5" target="0, 0.1, 0" up="0, 1, 0"/></transform>
  <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="48"/>
  <rfilter type="box"/></film><sampler type="independent"/></sensor>"""


def test_stock_mitsuba_renders_the_same(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    part = PART.replace("<float", '<rgb name="base_color" value="0.6, 0.3, 0.1"/><float')
    path = make_scene(
        part=part,
        extra=f'<default name="bright" value="2"/>{SENSOR}',
        light="""<emitter type="constant">
        <float name="radiance" value="$bright"/></emitter>""",
    )
    scene = load_edit_scene(path, {"bright": "1.5"})
    exported(scene, tmp_path / "plain", formats=["mitsuba"])
    exported(scene, tmp_path / "baked", lambda p: Learned(p, plain=True), formats=["mitsuba"])
    plain = stock_render(tmp_path / "plain" / "mitsuba" / "scene.xml", tmp_path / "plain.npy")
    baked = stock_render(tmp_path / "baked" / "mitsuba" / "scene.xml", tmp_path / "baked.npy")
    asset = part_of(scene)["part"]
    trimesh.Trimesh(asset.vertices, asset.faces, process=False).export(tmp_path / "ball.ply")
    own = make_scene(
        part="",
        region=f'<shape type="ply"><string name="filename" value="ball.ply"/>{part}</shape>',
        integrator='<integrator type="path"/>',
        light='<emitter type="constant"><float name="radiance" value="1.5"/></emitter>',
        extra=SENSOR,
    )
    reference = stock_render(own, tmp_path / "own.npy")
    assert reference.max() > 0.5 and np.ptp(reference[..., 0] - reference[..., 2]) > 0.1
    assert np.abs(plain - reference).mean() < 2e-3  # the same random numbers; normals differ in their last bits
    assert np.abs(baked - reference).mean() < 4e-3  # 8-bit textures
    text = (tmp_path / "plain" / "mitsuba" / "scene.xml").read_text()
    assert "dual_path" not in text and "focal_region" not in text and "$" not in text


def test_textured_part_renders_as_the_field_says(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    """Albedo of the exported scene, ray by ray, against the field at the points that the rays hit."""
    scene = load_edit_scene(make_scene(extra=SENSOR))
    exported(scene, tmp_path / "out", Learned, size=256, formats=["mitsuba"])
    path = tmp_path / "out" / "mitsuba" / "scene.xml"
    tree = ET.parse(path)
    tree.getroot().remove(tree.find("shape[@id='body']"))
    tree.write(path)
    loaded = mi.load_file(str(path), parallel=False)
    integrator = mi.load_dict({"type": "aov", "aovs": "p:position,a:albedo"})
    values = np.array(mi.render(loaded, integrator=integrator, spp=1)).reshape(-1, 6)
    on_part = np.any(values[:, :3] != 0, axis=1)
    assert on_part.sum() > 50
    points = torch.from_numpy(scene.frame.to_canonical(values[on_part, :3]).astype(np.float32))
    assert np.abs(values[on_part, 3:6] - Learned(points).base_color.numpy()).max() < 0.03


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"formats": ["fbx"]}, "--format: unknown format 'fbx'; known: glb, obj, ply, mitsuba"),
        ({"size": 3}, "--texture-size 3"),
    ],
)
def test_bad_options_are_one_line(make_scene: Make, tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        exported(load_edit_scene(make_scene()), tmp_path / "out", **change)


def test_bad_parts_are_one_line(make_scene: Make, tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene())
    solid = part_of(scene)["part"]
    flat = PartAsset(solid.vertices * [1, 1, 0], solid.faces)
    nothing = PartAsset(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    for parts, message in (
        ({"part": flat}, "'part' has no volume"),
        ({"part": nothing}, "'part' has no volume"),
        ({"Base": solid}, "has the name of the base"),
        ({"horn": solid, "Horn": solid}, "has the name of horn"),
        ({}, "no part to export"),
    ):
        with pytest.raises(UserError, match=message):
            export_assets(scene, RunConfig(), parts, tmp_path / "out", texture_size=64)
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        exported(scene, tmp_path / "file" / "below")


def test_missing_texture_is_one_line(make_scene: Make, textured_base: str, tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene(base=textured_base))
    (tmp_path / "paint.png").unlink()
    with pytest.raises(UserError, match="paint.png"):
        exported(scene, tmp_path / "out")


@needs_validator
def test_khronos_validator_finds_nothing(make_scene: Make, textured_base: str, tmp_path: Path) -> None:
    moved = BASE.replace("<bsdf", f"{MOVED}<bsdf")
    files = []
    for number, (base, region, values) in enumerate(
        [(textured_base, None, Learned), (moved, FAR_REGION, None), (BASE + textured_base, None, Learned)]
    ):
        scene = load_edit_scene(make_scene(base=base, **({"region": region} if region else {})))
        exported(scene, tmp_path / str(number), values, formats=["glb"])
        files.append(tmp_path / str(number) / "asset.glb")
    assert glb_faults(*files) == {}


def test_formats_are_all_written(make_scene: Make, tmp_path: Path) -> None:
    result = exported(load_edit_scene(make_scene()), tmp_path / "out")
    assert len(FORMATS) == 4
    for name in ("asset.glb", "obj/asset.obj", "ply/part_part.ply", "mitsuba/scene.xml"):
        assert name in result["files"] and (tmp_path / "out" / name).stat().st_size > 0
