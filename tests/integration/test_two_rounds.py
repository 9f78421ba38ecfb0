"""A result edited again: earlier parts are base, and stay what they were; hiding, showing and removing parts."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
from conftest import REGION
from tiny_runs import run_words, write_place

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.runs.run_folder import describe_run
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.training.checkpoint import CheckpointHeader, checkpoint_folder, save_checkpoint
from fd_mitsuba.training.geometry_stage import GeometryStage

WINGS = REGION.replace("<transform", '<string name="part" value="wings"/><transform')
HORN = """<shape type="focal_region" id="horn">{name}<transform name="to_world">
  <scale x="$thin" y="0.15" z="0.06"/><translate x="0" y="0.5" z="0.55"/></transform></shape>"""
PROMPT = "a pig with wings and a horn"
GOLD = '<bsdf type="roughconductor" id="part"><string name="material" value="Au"/></bsdf>'
SETTINGS = """
[geometry]
grid_resolution = 20
lambda_sds = 0.0
steps = 2
[appearance]
steps = 2
lambda_sds = 0.0
views = 1
spp = 1
picture_size = 16
[output]
texture_size = 64
turntable_frames = 2
turntable_size = 16
picture_size = 0
"""


class Learned:
    """A material for every point, bumpy and patterned."""

    def __init__(self, points: torch.Tensor) -> None:
        wave = 0.5 + 0.4 * torch.sin(6 * points)
        self.base_color, self.roughness, self.metallic = wave, wave[:, :1], wave[:, 1:2]
        normal = torch.cat([0.3 * torch.cos(9 * points[:, :2]), torch.ones(len(points), 1)], dim=1)
        self.normal = normal / normal.norm(dim=1, keepdim=True)


def regions(folder: Path, *more: str, name: str = '<string name="part" value="horn"/>') -> Path:
    path = folder / "horn.xml"
    pieces = ['<scene version="3.0.0"><default name="thin" value="0.06"/>', HORN.format(name=name), *more, "</scene>"]
    path.write_text("\n".join(pieces))
    return path


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    """The export folder of a first round: a pig with textured wings."""
    root = write_place(tmp_path_factory.mktemp("first"), animal, SETTINGS, region=WINGS)
    scene = load_edit_scene(root / "scene.xml")
    vertices, faces = unit_sphere(3)
    centre = scene.frame.to_user(scene.regions[0].centre)
    part = PartAsset(vertices * [0.12, 0.25, 0.15] + centre, faces, Learned)
    export_assets(scene, RunConfig(), {"wings": part}, root / "export", texture_size=64)
    return root / "export"


def again(first: Path, folder: Path, **options: str) -> EditScene:
    return load_edit_scene(first / "mitsuba" / "scene.xml", regions=regions(folder, **options), prompt=PROMPT)


@pytest.fixture(scope="module")
def second(first: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a second round; its part is still the region."""
    root = tmp_path_factory.mktemp("second")
    scene, config, folder = again(first, root), RunConfig.load(first.parent / "tiny.toml"), root / "run"
    describe_run(scene, config, folder, "fd_mitsuba run")
    stage = GeometryStage(scene, config, None)
    header = CheckpointHeader(stage.name, 2, config.content_hash(stage.name), counters=dict(stage.counters))
    save_checkpoint(checkpoint_folder(folder, stage.name), header, stage.field, stage.optimiser, keep=1)
    assert main(["export", str(folder), "--texture-size", "64"]) == 0
    return folder


def of_part(folder: Path, name: str) -> dict[str, bytes]:
    """The exported files of a part: name -> bytes."""
    return {path.name: path.read_bytes() for path in sorted(folder.rglob(f"part_{name}*"))}


def node(glb: Path, name: str) -> dict[str, bytes]:
    """The bytes of a node's vertices, normals, triangles and pictures."""
    file = pygltflib.GLTF2().load(glb)
    primitive = file.meshes[next(item.mesh for item in file.nodes if item.name == name)].primitives[0]

    def view(index: int) -> bytes:
        place = file.bufferViews[index]
        return file.binary_blob()[place.byteOffset : place.byteOffset + place.byteLength]

    material = file.materials[primitive.material]
    pbr = material.pbrMetallicRoughness
    wanted = {"base": pbr.baseColorTexture, "orm": pbr.metallicRoughnessTexture, "normal": material.normalTexture}
    found = {key: view(file.images[file.textures[t.index].source].bufferView) for key, t in wanted.items()}
    attributes = {"positions": primitive.attributes.POSITION, "normals": primitive.attributes.NORMAL}
    attributes |= {"faces": primitive.indices, "tangents": primitive.attributes.TANGENT}
    return found | {key: view(file.accessors[index].bufferView) for key, index in attributes.items()}


def test_the_first_part_is_byte_for_byte_what_it_was(first: Path, second: Path) -> None:
    before, after = of_part(first / "mitsuba", "wings"), of_part(second / "export" / "mitsuba", "wings")
    assert len(before) == 6 and before == after  # mesh, colour, roughness, metallic, two normal maps
    assert (second / "export" / "ply" / "part_wings.ply").read_bytes() == before["part_wings.ply"]
    old, new = node(first / "asset.glb", "part_wings"), node(second / "export" / "asset.glb", "part_wings")
    assert old.keys() == new.keys()
    assert {key for key in old if old[key] != new[key]} <= {"normals", "tangents"}  # Mitsuba normalises what it reads
    for key, tolerance in (("normals", 1e-6), ("tangents", 1e-4)):
        assert np.abs(np.frombuffer(old[key], "<f4") - np.frombuffer(new[key], "<f4")).max() < tolerance


def test_both_parts_are_separate(second: Path) -> None:
    file = pygltflib.GLTF2().load(second / "export" / "asset.glb")
    assert [file.nodes[i].name for i in file.scenes[0].nodes] == ["base", "part_wings", "part_horn"]
    assert file.nodes[file.scenes[0].nodes[1]].extras["prompt"] == "a pig with two wings"
    groups = [line for line in (second / "export" / "obj" / "asset.obj").read_text().splitlines() if line[:2] == "g "]
    assert groups == ["g base", "g part_wings", "g part_horn"]


def test_stock_mitsuba_loads_the_result(second: Path) -> None:
    code = """import sys, mitsuba as mi
mi.set_variant("scalar_rgb")
print(*sorted(shape.id() for shape in mi.load_file(sys.argv[1], parallel=False, optimize=False).shapes()))"""
    path = second / "export" / "mitsuba" / "scene.xml"
    out = subprocess.run([sys.executable, "-c", code, path], check=True, capture_output=True, text=True).stdout
    assert out.split() == ["body", "part_horn", "part_wings"]


def test_the_stack_is_listed(second: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["parts", str(second), "--json"]) == 0
    wings, horn = json.loads(capsys.readouterr().out)
    assert (wings["name"], wings["round"], wings["prompt"]) == ("wings", 1, "a pig with two wings")
    assert (horn["name"], horn["round"], horn["prompt"]) == ("horn", 2, PROMPT)
    vertices, faces = unit_sphere(3)
    assert wings["faces"] == len(faces) and wings["file"] == "files/part_wings.ply"


def test_hidden_parts_come_back_and_removed_ones_do_not(second: Path, capfd: pytest.CaptureFixture[str]) -> None:
    export = second / "export"

    def state() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in sorted(export.rglob("*")) if path.is_file()}

    before = state()
    assert main(["parts", str(second), "--hide", "wings"]) == 0
    assert "hidden" in capfd.readouterr().out
    assert "part_wings" not in (export / "mitsuba" / "scene.xml").read_text()
    assert "part_wings" not in (export / "obj" / "asset.obj").read_text()
    file = pygltflib.GLTF2().load(export / "asset.glb")
    assert [item.name for item in file.nodes] == ["base", "part_horn"]
    assert main(["parts", str(second), "--hide", "horn"]) == 1
    assert "last part" in capfd.readouterr().err
    assert main(["parts", str(second), "--show", "wings"]) == 0
    assert state() == before
    capfd.readouterr()
    assert main(["parts", str(second), "--remove", "horn"]) == 0
    assert "horn" not in capfd.readouterr().out
    assert list(export.rglob("part_horn*")) == []
    assert main(["export", str(second), "--format", "mitsuba", "--texture-size", "64"]) == 0
    assert "part_horn" not in (export / "mitsuba" / "scene.xml").read_text()
    assert {path: data for path, data in before.items() if "part_wings" in path.name}.items() <= state().items()
    assert main(["parts", str(second), "--show", "horn"]) == 1
    assert "has no part 'horn'" in capfd.readouterr().err


def test_a_stock_scene_is_edited_in_its_own_frame(first: Path, tmp_path: Path) -> None:
    scene = again(first, tmp_path)
    assert (scene.prompt, scene.base_prompt) == (PROMPT, "a pig with two wings")
    assert [mesh.name for mesh in scene.base] == ["body", "part_wings"] and list(scene.parts) == ["horn"]
    assert np.allclose(scene.frame.to_user(scene.regions[0].centre), [0, 0.5, 0.55], atol=1e-6)
    assert "horn.xml" in [path.name for path in scene.files]


def test_what_the_file_of_regions_says_counts(first: Path, tmp_path: Path) -> None:
    integrator = '<integrator type="dual_path"><string name="prompt" value="a pig with a $what"/></integrator>'
    path = regions(tmp_path, integrator, GOLD)
    scene = load_edit_scene(first / "mitsuba" / "scene.xml", {"thin": "0.09", "what": "horn"}, path)
    assert scene.prompt == "a pig with a horn" and scene.has_part_bsdf
    extent = np.ptp(np.array(scene.regions[0].bounds), axis=0)[0] / scene.frame.scale
    assert extent == pytest.approx(0.18, rel=0.01)
    assert part_material(scene).plugin == "roughconductor"


def test_a_file_of_regions_adds_to_those_of_the_scene(first: Path, tmp_path: Path) -> None:
    scene = load_edit_scene(first.parent / "scene.xml", regions=regions(tmp_path))
    assert list(scene.parts) == ["wings", "horn"] and scene.prompt == "a pig with two wings"


def test_regions_without_a_name_get_a_free_one(first: Path, tmp_path: Path) -> None:
    assert list(again(first, tmp_path, name="").parts) == ["part"]
    exported = tmp_path / "scene.xml"
    text = (first / "mitsuba" / "scene.xml").read_text().replace('"part_wings"', '"part_part"')
    exported.write_text(text.replace('"files/', f'"{first}/mitsuba/files/'))
    assert list(load_edit_scene(exported, regions=regions(tmp_path, name=""), prompt=PROMPT).parts) == ["part_2"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace('"horn"/>', '"Wings"/>'), ("horn.xml", "'Wings' is there", "Wings_2")),
        (lambda text: text.replace("focal_region", "sphere"), ("horn.xml: no focal region", "--regions")),
        (lambda text: text.replace("$thin", "0"), ("horn.xml", "singular")),
        (lambda text: text.replace('type="focal_region"', 'type="focal_region" colour="red"'), ("horn.xml",)),
        (lambda text: text.replace('y="0.5"', 'y="5"'), ("horn.xml", "move")),
        (lambda text: "", ("horn.xml", "empty")),
    ],
)
def test_bad_regions_are_one_line(
    first: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], change: Callable[[str], str], words: tuple[str, ...]
) -> None:
    path = regions(tmp_path)
    path.write_text(change(path.read_text()))
    assert main(["check", str(first / "mitsuba" / "scene.xml"), "--regions", str(path), "--prompt", PROMPT]) == 1
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and all(word in message for word in words), message


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), ("dual_path", "--prompt")),
        (("--prompt", " "), ("--prompt: is blank",)),
        (("--prompt", PROMPT, "--regions", "nowhere.xml"), ("nowhere.xml: no such scene file",)),
        (("--prompt", PROMPT), ("no focal region", "--regions")),
    ],
)
def test_an_exported_scene_alone_is_one_line(
    first: Path, capfd: pytest.CaptureFixture[str], more: tuple[str, ...], words: tuple[str, ...]
) -> None:
    assert main(["check", str(first / "mitsuba" / "scene.xml"), *more]) == 1
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and all(word in message for word in words), message


def test_bad_records_and_folders_are_one_line(first: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for folder, word in ((tmp_path / "nowhere", "no such run folder"), (tmp_path, "not exported yet")):
        assert main(["parts", str(folder)]) == 1
        assert word in capfd.readouterr().err
    record = first / "mitsuba" / "stack.json"
    text = record.read_text()
    try:
        for broken in (
            "{",
            "[]",
            text.replace('"round": 1', '"round": "x"'),
            text.replace('"prompt": "', '"prompt": 1, "x": "'),
        ):
            record.write_text(broken)
            with pytest.raises(UserError, match=r"stack.json: is damaged"):
                again(first, tmp_path)
        record.unlink()
        assert [part.name for part in again(first, tmp_path).earlier] == ["wings"]
    finally:
        record.write_text(text)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_whole_rounds(first: Path, tmp_path: Path) -> None:
    """Both stages of both rounds, with no guidance and two steps each."""
    place, one, two = first.parent, tmp_path / "one", tmp_path / "two"
    assert main(run_words(place, str(one))) == 0
    more = ["--regions", str(regions(tmp_path)), "--prompt", PROMPT]
    assert main(run_words(place, str(two), *more, scene=one / "export" / "mitsuba" / "scene.xml")) == 0
    before = of_part(one / "export" / "mitsuba", "wings")
    assert len(before) >= 4 and before == of_part(two / "export" / "mitsuba", "wings")
    file = pygltflib.GLTF2().load(two / "export" / "asset.glb")
    assert [item.name for item in file.nodes] == ["base", "part_wings", "part_horn"]
