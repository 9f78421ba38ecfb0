"""Scenes far from the origin, and of tiny and huge units, against the same scene at the origin."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from cases import CASES
from PIL import Image
from pygltflib import GLTF2
from scipy.spatial import KDTree

from fd_mitsuba.config import GeometryConfig, RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.part_check import check_parts
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.export.meshes import write_mesh
from fd_mitsuba.export.solid.part_solid import part_solid
from fd_mitsuba.io.float_steps import float_step, is_coarse, size_warnings
from fd_mitsuba.io.ply import ply_bytes
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.part_shading import PartShading
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.views import ring_views
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.viewing.preview import preview_scene

FAR = CASES / "far_from_origin" / "far1"
AWAY = np.array([45200.0, 35.0, 54110.0])
SCENE = """<scene version="3.0.0"><integrator type="dual_path"><string name="prompt" value="a ball with a hat"/>
  <string name="base_prompt" value="a ball"/></integrator>{light}
  <shape type="{kind}" id="base"><string name="filename" value="m.{kind}"/><bsdf type="diffuse"/></shape>
  <shape type="focal_region" id="hat"><transform name="to_world"><scale x="{x}" y="{y}" z="{x}"/>
    <translate x="{place[0]}" y="{place[1]}" z="{place[2]}"/></transform></shape></scene>"""


SKY = '<emitter type="constant"/>'
POINT = """<emitter type="point"><point name="position" x="{}" y="{}" z="{}"/><rgb name="intensity" value="20"/>
  </emitter>"""
SPOT = """<emitter type="spot"><rgb name="intensity" value="40"/><float name="cutoff_angle" value="80"/>
  <transform name="to_world"><rotate y="1" angle="180"/><translate x="{}" y="{}" z="{}"/></transform></emitter>"""
LAMP = """<shape type="sphere" id="lamp"><float name="radius" value="0.5"/><emitter type="area"/>
  <transform name="to_world"><translate x="{}" y="{}" z="{}"/></transform></shape>"""


def positions() -> tuple[np.ndarray, list[str]]:
    """The far ball's vertices as the file has them, and the lines of its faces."""
    lines = (FAR / "m.ply").read_text().splitlines()
    start = lines.index("end_header") + 1
    rows = [[float(value) for value in line.split()] for line in lines[start : start + 1225]]
    return np.array(rows), lines[start + 1225 :]


def ball(folder: Path, scale: float = 1.0, kind: str = "ply", away: np.ndarray | None = None, light: str = SKY) -> Path:
    """The same ball elsewhere, in another unit or format."""
    away = np.zeros(3) if away is None else away
    light = light.format(*(away + np.array([1.5, 3, 4]) * scale))
    found, faces = positions()
    rows = [" ".join(f"{value:.17g}" for value in row) for row in (found - AWAY) * scale + away]
    if kind == "obj":
        corners = [[int(value) + 1 for value in line.split()[1:]] for line in faces]
        text = [*(f"v {row}" for row in rows), *("f " + " ".join(map(str, corner)) for corner in corners)]
    else:
        text = [
            "ply",
            "format ascii 1.0",
            f"element vertex {len(rows)}",
            *(f"property double {axis}" for axis in "xyz"),
        ]
        text += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", *rows, *faces]
    (folder / f"m.{kind}").write_text("\n".join(text) + "\n")
    path = folder / "scene.xml"
    place = np.array([0, 1.25, 0]) * scale + away
    path.write_text(SCENE.format(light=light, kind=kind, x=0.55 * scale, y=0.5 * scale, place=place))
    return path


def grown(scene: EditScene, folder: Path) -> trimesh.Trimesh:
    """The part at the start of a run, as its PLY says."""
    config = RunConfig(geometry=GeometryConfig(grid_resolution=24, steps=2))
    solid = part_solid(GeometryStage(scene, config, None).grown(), "part")
    write_mesh(folder / "part.ply", solid.vertices, solid.faces, scene)
    return trimesh.load(folder / "part.ply", process=False)


def areas(mesh: trimesh.Trimesh) -> np.ndarray:
    corners = np.asarray(mesh.vertices, dtype=np.float64)[mesh.faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def test_a_part_far_away_is_as_clean_as_at_the_origin(tmp_path: Path) -> None:
    (tmp_path / "near").mkdir()
    near = grown(load_edit_scene(ball(tmp_path / "near")), tmp_path / "near")
    far = grown(load_edit_scene(FAR / "scene.xml"), tmp_path)
    assert len(far.vertices) == len(near.vertices) == 738
    np.testing.assert_allclose(areas(far), areas(near), rtol=1e-3, atol=1e-9)
    assert areas(far).min() > 1e-8 and far.is_watertight
    np.testing.assert_allclose(far.vertices - AWAY, near.vertices, atol=1e-5)


def test_the_volume_of_a_part_far_away_is_measured(tmp_path: Path) -> None:
    """Of a ball, 50 km away."""
    vertices, faces = unit_sphere(4)
    (tmp_path / "export").mkdir()
    for away in (np.zeros(3), AWAY):
        (tmp_path / "export" / "part_hat.ply").write_bytes(ply_bytes(vertices + away, faces))
        found = check_parts(["hat"], tmp_path, 0.5)["hat"]
        assert found["valid"] and found["volume"] == pytest.approx(4 / 3 * np.pi / 8, rel=5e-3)


@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_the_base_keeps_the_digits_of_its_file(tmp_path: Path, kind: str) -> None:
    """Mitsuba reads steps of 0.004 of it."""
    (mesh,) = load_edit_scene(ball(tmp_path, kind=kind, away=AWAY)).base
    found, faces = positions()
    right = found[np.array([[int(value) for value in line.split()[1:]] for line in faces])]
    np.testing.assert_allclose(mesh.vertices[mesh.faces], right, atol=1e-9)


def test_check_names_the_step() -> None:
    (warning,) = check_scene(load_edit_scene(FAR / "scene.xml"), RunConfig.load("quick")).warnings
    assert "reach 5.41e+04, where 32-bit floats are 0.0039 apart, 0.12% of its size" in warning
    assert "move everything to the origin" in warning


@pytest.mark.parametrize(("distance", "told"), [(0.0, False), (500.0, False), (5000.0, True)])
def test_only_visible_steps_are_told(tmp_path: Path, distance: float, told: bool) -> None:
    scene = load_edit_scene(ball(tmp_path, away=np.array([distance, 0, 0])))
    assert any("32-bit floats are" in line for line in check_scene(scene, RunConfig()).warnings) == told


def test_steps_are_those_of_numpy() -> None:
    points = np.array([[54110.0, 1, 2], [54112.0, 0, 0]])
    assert np.float32(54110.0) + np.float32(0.4 * float_step(points)) == np.float32(54110.0)
    assert np.float32(54110.0) + np.float32(float_step(points)) > np.float32(54110.0)
    assert is_coarse(points) and not is_coarse(points - points[0]) and not is_coarse(np.zeros((0, 3)))


def test_exports_far_away_are_the_near_ones_moved(tmp_path: Path, mi: Any) -> None:
    """GLB, OBJ and PLY: corner for corner what the scene at the origin gives."""
    made = {}
    for name, away in (("near", np.zeros(3)), ("far", AWAY)):
        (tmp_path / name).mkdir()
        scene = load_edit_scene(ball(tmp_path / name, away=away))
        solid = part_solid(
            GeometryStage(scene, RunConfig(geometry=GeometryConfig(grid_resolution=24)), None).grown(), "part"
        )
        part = PartAsset(scene.frame.to_user(solid.vertices), solid.faces)
        export_assets(scene, RunConfig(), {"part": part}, tmp_path / name / "out", texture_size=64)
        glb = GLTF2().load(str(tmp_path / name / "out/asset.glb"))
        arrays = []
        for node in (node for node in glb.nodes if node.mesh is not None):
            entry = glb.accessors[glb.meshes[node.mesh].primitives[0].attributes.POSITION]
            view = glb.bufferViews[entry.bufferView]
            values = np.frombuffer(glb.binary_blob(), np.float32, entry.count * 3, view.byteOffset or 0).reshape(-1, 3)
            place = np.eye(4) if node.matrix is None else np.array(node.matrix).reshape(4, 4).T
            arrays.append(values @ place[:3, :3].T + place[:3, 3])
        lines = [line.split() for line in (tmp_path / name / "out/obj/asset.obj").read_text().splitlines()]
        arrays.append(np.array([line[1:] for line in lines if line[0] == "v"], dtype=float))
        ply = trimesh.load(tmp_path / name / "out/ply/part_part.ply", process=False)
        arrays.append(np.asarray(ply.vertices, dtype=float))
        assert areas(ply).min() > 1e-8
        made[name] = arrays
    for near, far in zip(made["near"], made["far"], strict=True):
        # Seams of the atlas may run elsewhere, so that vertices are split elsewhere.
        assert max(KDTree(far - AWAY).query(near)[0].max(), KDTree(near).query(far - AWAY)[0].max()) < 1e-5
    assert mi.load_file(str(tmp_path / "far/out/mitsuba/scene.xml")).bbox().min[0] > 45000


@pytest.mark.parametrize("light", [SKY, POINT, SPOT, LAMP])
def test_renders_far_away_are_those_at_the_origin(tmp_path: Path, mi: Any, light: str) -> None:
    """Base and part under every kind of light; without moving, the ball has steps and its shadows blotches."""
    pictures = []
    for name, away in (("near", np.zeros(3)), ("far", AWAY)):
        (tmp_path / name).mkdir()
        scene = load_edit_scene(ball(tmp_path / name, away=away, light=light))
        hat = scene.regions[0].surface(3)
        shading = PartShading({"type": "diffuse"})
        rendering = AppearancePass(scene, {"part": hat}, shading, 48, 16)
        cameras = ring_views(2, 20.0, fov_deg=45.0, radius=3.4)
        gbuffer = rendering.trace(cameras, 0)
        pictures.append(rendering.render_base(gbuffer, 0) + rendering.render_clay(gbuffer, 0))
        material = BaseAppearance(scene).lookup(torch.from_numpy(np.array(hat.vertices[:5])).float())
        assert material.base_color[:, 0] == pytest.approx([0.5] * 5, abs=1e-5)
    assert pictures[0].mean() > 2e-4
    difference = (pictures[0] - pictures[1]).abs()
    assert float(difference.mean() / pictures[0].mean()) < 2e-3
    assert float((difference > 0.05 * pictures[0].max()).float().mean()) < 2e-3


def test_the_preview_far_away_is_that_at_the_origin(tmp_path: Path) -> None:
    views = []
    for name, away in (("near", np.zeros(3)), ("far", AWAY)):
        (tmp_path / name).mkdir()
        (sheet,) = preview_scene(load_edit_scene(ball(tmp_path / name, away=away)), tmp_path / name, ["front"], 96)
        with Image.open(sheet) as image:
            place, picture = json.loads(image.info["fd_mitsuba"])["views"][0], np.asarray(image.convert("RGB"), float)
        views.append(picture[place["top"] :, place["left"] :][: place["size"], : place["size"]])  # without numbers
    assert np.abs(views[0] - views[1]).mean() < 0.5 and views[0].std() > 15


@pytest.mark.parametrize(
    ("scale", "words"), [(1e-12, "too small for 32-bit floats"), (1e12, "too large for 32-bit floats")]
)
def test_units_that_cannot_be_rendered_are_refused(tmp_path: Path, scale: float, words: str) -> None:
    with pytest.raises(UserError, match=f"base base: its longest side is .*{words}; give it a size near 1"):
        load_edit_scene(ball(tmp_path, scale))


def test_the_tiny_scene_is_refused() -> None:
    with pytest.raises(UserError, match="end_s1e-30.xml: base base: its longest side is 2e-30, too small"):
        load_edit_scene(CASES / "tiny_units" / "end_s1e-30.xml")


def test_small_units_are_told(tmp_path: Path) -> None:
    scene = load_edit_scene(ball(tmp_path, 1e-4))
    (warning,) = [line for line in check_scene(scene, RunConfig()).warnings if "starts rays" in line]
    assert "longest side is 0.00032" in warning and "scale everything by 10000" in warning
    assert not any("starts rays" in line for line in check_scene(load_edit_scene(ball(tmp_path)), RunConfig()).warnings)


def test_the_warning_about_small_units_is_measured(mi: Any) -> None:
    """A ball on another: below the size that is told, Mitsuba's picture of the same thing is another one."""
    vertices, faces = unit_sphere(3)

    def picture(scale: float) -> np.ndarray:
        place = mi.ScalarTransform4f().look_at(origin=[0.2 * scale, 0, 8 * scale], target=[0, 0, 0], up=[0, 1, 0])
        film = {"type": "hdrfilm", "width": 48, "height": 48, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        content: dict[str, Any] = {"type": "scene", "light": {"type": "constant"}}
        for number, height in enumerate((-0.98, 0.98)):
            properties = mi.Properties()
            properties["bsdf"] = mi.load_dict({"type": "diffuse"})
            mesh = mi.Mesh(f"ball_{number}", len(vertices), len(faces), props=properties, has_vertex_normals=True)
            parameters = mi.traverse(mesh)
            moved = (vertices + [0, height, 0]) * scale
            parameters["vertex_positions"] = np.ascontiguousarray(moved.ravel(), dtype=np.float32)
            parameters["faces"] = np.ascontiguousarray(faces.ravel(), dtype=np.uint32)
            parameters.update()
            content[f"ball_{number}"] = mesh
        content["sensor"] = {
            "type": "perspective",
            "fov": 30,
            "near_clip": 0.01 * scale,
            "far_clip": 100 * scale,
            "to_world": place,
            "film": film,
        }
        loaded = mi.load_dict(content, optimize=False)
        integrator = mi.load_dict({"type": "direct", "hide_emitters": True})
        return np.array(mi.render(loaded, integrator=integrator, spp=64, seed=0))

    right = picture(1.0)
    for scale in (0.01, 1e-5):
        told = bool(size_warnings(4 * scale * vertices))
        assert (float(np.sqrt(((picture(scale) - right) ** 2).mean())) > 0.01) == told, scale


Make = Callable[..., Path]


def test_nothing_changes_near_the_origin(make_scene: Make) -> None:
    scene = load_edit_scene(make_scene())
    assert not scene.origin.any() and not is_coarse(scene.base_soup.vertices)
