"""One object of a furnished scene is edited: floor, wall, another object and a curve are light and shadow, no more."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import BASE

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.mitsuba_xml import mitsuba_scene
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.part_shading import PartShading
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.viewing.lit_views import ring_cameras
from fd_mitsuba.viewing.own_sensor import seen_by

GREY = '<bsdf type="diffuse"/>'
FLOOR = f'<shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/><translate y="-0.6"/></transform>{GREY}</shape>'  # noqa: E501
ROOF = f'<shape type="rectangle"><transform name="to_world"><scale x="0.5" y="3"/><rotate x="1" angle="90"/><translate x="-0.5" y="1.5"/></transform>{GREY}</shape>'  # noqa: E501
CRATE = f'<shape type="cube" id="crate"><transform name="to_world"><scale value="0.4"/><translate x="1.5" y="-0.2"/></transform>{GREY}</shape>'  # noqa: E501
ROPE = f'<shape type="linearcurve" id="rope"><string name="filename" value="rope.txt"/>{GREY}</shape>'
GROUP = (
    f'<shape type="shapegroup" id="bush"><shape type="sphere"><float name="radius" value="0.2"/>{GREY}</shape></shape>'  # noqa: E501
)
COPY = '<shape type="instance" id="copy"><ref id="bush"/><transform name="to_world"><translate x="-2"/></transform></shape>'  # noqa: E501
LAMP = '<shape type="sphere" id="lamp"><float name="radius" value="0.1"/><transform name="to_world"><translate y="9"/></transform><emitter type="area"/></shape>'  # noqa: E501
SUN = '<emitter type="directional"><vector name="direction" x="0" y="-1" z="0"/></emitter>'
SENSOR = """<sensor type="perspective" id="door"><float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="1, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
  <film type="hdrfilm"><integer name="width" value="40"/><integer name="height" value="24"/></film></sensor>"""
NAMED = '<integrator type="dual_path"><string name="prompt" value="a pig with two wings"/><string name="base" value="{}"/></integrator>'  # noqa: E501

Make = Callable[..., Path]


@pytest.fixture
def furnished(make_scene: Make, tmp_path: Path) -> Callable[..., Path]:
    """A function that writes the scene with all that stands around."""
    (tmp_path / "rope.txt").write_text("-1 -0.5 1 0.05\n0 -0.5 1.4 0.05\n1 -0.5 1 0.05\n")

    def make(**changed: str) -> Path:
        around = changed.pop("around", FLOOR + ROOF + CRATE + ROPE + GROUP + COPY + LAMP + SENSOR)
        return make_scene(**{"base": around + BASE, "light": SUN, **changed})

    return make


def test_what_the_region_touches_is_edited(furnished: Make, make_scene: Make) -> None:
    alone = load_edit_scene(make_scene())
    scene = load_edit_scene(furnished())
    assert [mesh.name for mesh in scene.base] == ["body"] and [item.id for item in scene.base_elements] == ["body"]
    assert scene.surroundings_ids == ["floor", "surroundings", "crate", "rope", "bush", "copy"]
    assert scene.frame.scale == alone.frame.scale and np.array_equal(scene.frame.centre, alone.frame.centre)
    assert scene.base_choice.startswith("edited: body; surroundings: floor, a rectangle, crate, rope, bush, copy")


def test_a_part_of_the_same_object_is_edited_too(furnished: Make) -> None:
    eye = f'<shape type="sphere" id="eye"><float name="radius" value="0.05"/><point name="center" x="0" y="0.3" z="0.7"/>{GREY}</shape>'  # noqa: E501
    scene = load_edit_scene(furnished(around=FLOOR + CRATE + eye))
    assert [mesh.name for mesh in scene.base] == ["eye", "body"]


def test_a_flat_piece_of_the_object_is_edited_too(furnished: Make) -> None:
    pane = (
        f'<shape type="rectangle" id="pane"><transform name="to_world"><scale value="0.05"/></transform>{GREY}</shape>'  # noqa: E501
    )
    scene = load_edit_scene(furnished(around=FLOOR + CRATE + pane))
    assert [mesh.name for mesh in scene.base] == ["pane", "body"] and "floor" in scene.base_choice
    alone = load_edit_scene(furnished(around=pane))
    assert [mesh.name for mesh in alone.base] == ["pane", "body"] and alone.base_choice == ""


def test_a_room_around_the_region_is_not_touched_by_it(furnished: Make) -> None:
    room = f'<shape type="cube" id="room"><transform name="to_world"><scale value="5"/></transform>{GREY}</shape>'
    assert [mesh.name for mesh in load_edit_scene(furnished(around=FLOOR + room)).base] == ["body"]


def test_without_anything_flat_all_shapes_are_edited(furnished: Make) -> None:
    scene = load_edit_scene(furnished(around=CRATE))
    assert [mesh.name for mesh in scene.base] == ["crate", "body"]
    assert scene.surroundings == () and scene.base_choice == ""


@pytest.mark.parametrize(
    ("names", "base"), [("body", ["body"]), (" crate ,body", ["crate", "body"]), ("crate", ["crate"])]
)
def test_a_scene_names_its_base(furnished: Make, names: str, base: list[str]) -> None:
    path = furnished(integrator=NAMED.format(names))
    scene = load_edit_scene(path, on_misplaced=lambda error: None)
    assert [mesh.name for mesh in scene.base] == base and scene.base_choice == ""


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("bodi", "base 'bodi': no shape of scene.xml has this id; nearest: body"),
        ("body,lamp", "base 'lamp' is a lamp or a region; name the shapes to edit, of floor, crate"),
        ("wing", "base 'wing' is a lamp or a region"),
        (" , ", "base is blank"),
        ("rope", "cannot be turned into a mesh"),
    ],
)
def test_wrong_names_are_one_line(furnished: Make, names: str, said: str) -> None:
    with pytest.raises(UserError) as caught:
        load_edit_scene(furnished(integrator=NAMED.format(names)))
    assert said in str(caught.value) and str(caught.value).count("\n") == 0 and "scene.xml" in str(caught.value)


def whole_as_stock(scene: EditScene, part: TriangleMesh, camera: Any, size: int, spp: int) -> np.ndarray:
    """Stock Mitsuba's `path` over everything, the part in grey: linear RGB (size, size, 3)."""
    file, mi = scene.inputs.scene, scene.inputs.scene.mi
    loaded = file.instantiate(("focal_region", "sensor", "integrator"))
    mesh = mi.Mesh("part", len(part.vertices), len(part.faces), props=props(mi))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.frame.to_user(part.vertices).ravel().astype(np.float32)
    parameters["faces"] = part.faces.ravel().astype(np.uint32)
    parameters.update()
    objects = [*loaded.shapes(), mesh, *(e for e in loaded.emitters() if e.get_shape() is None)]
    content = {"type": "scene"} | {f"object_{number}": item for number, item in enumerate(objects)}
    position, target = (scene.frame.to_user(point[0]) for point in (camera.position, camera.target))
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at(position.tolist(), target.tolist(), camera.basis()[1][0].tolist())
    sensor = mi.load_dict({"type": "perspective", "fov": float(camera.fov_deg[0]), "to_world": look, "film": film})
    path = mi.load_dict({"type": "path", "max_depth": 2})
    return np.array(mi.render(mi.load_dict(content, optimize=False), sensor=sensor, integrator=path, spp=spp, seed=5))


def props(mi: Any) -> Any:
    found = mi.Properties()
    found["bsdf"] = mi.load_dict({"type": "diffuse"})
    return found


def test_the_surroundings_shade_the_object_as_in_stock_mitsuba(furnished: Make) -> None:
    """A roof over half of the animal: its shadow on base and part, under a light from straight above."""
    scene = load_edit_scene(furnished(around=FLOOR + ROOF + LAMP))
    vertices, faces = unit_sphere(3)
    part = TriangleMesh("part", vertices * 0.3 + [0.0, 0.75, 0.0], faces)
    appearance = AppearancePass(scene, {"part": part}, PartShading({"type": "diffuse"}), 40, 128)
    cameras = ring_cameras(1, np.zeros(3))
    gbuffer = appearance.trace(cameras, 3)
    values = np.full((len(gbuffer.points), 3), 0.5, np.float32)
    found = appearance.render(gbuffer, torch.from_numpy(values), None, None, None, 3)
    merged = found.merged[0].permute(1, 2, 0).numpy()
    expected = whole_as_stock(scene, part, cameras, 40, 128)
    for mask in (found.part_mask[0, 0] == 1, (found.alpha[0, 0] == 1) & (found.part_mask[0, 0] == 0)):
        assert mask.sum() > 20
        assert merged[mask].sum() == pytest.approx(expected[mask].sum(), rel=0.02)
    open_air = load_edit_scene(furnished(around=LAMP))
    bright = AppearancePass(open_air, {"part": part}, PartShading({"type": "diffuse"}), 40, 128)
    lit = bright.render_base(bright.trace(cameras, 3), 3)[0].permute(1, 2, 0).numpy()
    mask = (found.alpha[0, 0] == 1) & (found.part_mask[0, 0] == 0)
    assert merged[mask].sum() < 0.8 * lit[mask].sum()  # the roof is over half of it


def test_exports_keep_the_surroundings_and_the_next_round_knows_them(furnished: Make, tmp_path: Path) -> None:
    scene = load_edit_scene(furnished())
    data, copies = mitsuba_scene(scene, scene.inputs, [])
    shapes = {shape.get("id"): shape for shape in ET.fromstring(data).findall("shape")}
    assert list(shapes) == ["floor", "surroundings", "crate", "rope", "bush", "copy", "lamp", "body"]
    rope = shapes["rope"].find("string[@name='filename']")
    assert rope is not None
    name = Path(rope.get("value", "")).name
    assert copies[name].read_bytes() == (tmp_path / "rope.txt").read_bytes()
    folder = tmp_path / "export"
    (folder / "files").mkdir(parents=True)
    (folder / "scene.xml").write_bytes(data)
    for name, source in copies.items():
        (folder / "files" / name).write_bytes(source.read_bytes())
    record = {"parts": [], "export": {"surroundings": scene.surroundings_ids}}
    (folder / "stack.json").write_text(json.dumps(record))
    again = load_edit_scene(folder / "scene.xml", prompt="a pig with a hat", needs_region=False)
    assert [mesh.name for mesh in again.base] == ["body"]


def test_a_sensor_of_the_scene_shows_what_stock_mitsuba_shows(furnished: Make) -> None:
    file = load_edit_scene(furnished()).inputs.scene
    mi = file.mi
    image = seen_by(file, "door", 64, 3)
    assert image.shape == (24, 40, 3) and image.dtype == np.uint8
    stock = file.instantiate()
    drawn = mi.render(stock, sensor=0, integrator=mi.load_dict({"type": "path", "max_depth": 3}), spp=256, seed=9)
    bitmap = mi.Bitmap(drawn).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
    difference = np.abs(image.astype(float) - np.array(bitmap).astype(float))
    assert difference.mean() < 4 and image.std() > 20
    with pytest.raises(UserError, match=r"--sensor dor: .*scene\.xml has none of this id; there are door"):
        seen_by(file, "dor", 4, 3)
