from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import BASE, INTEGRATOR, write_ply

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.region_place import gap_to_base, share_in_grid
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import topology

Make = Callable[..., Path]


def shape(kind: str, inner: str = "", name: str = "body") -> str:
    return f'<shape type="{kind}" id="{name}">{inner}<bsdf type="diffuse"/></shape>'


def move(scale: str = "1", translate: tuple[float, float, float] = (0, 0, 0)) -> str:
    x, y, z = translate
    return f'<transform name="to_world"><scale value="{scale}"/><translate x="{x}" y="{y}" z="{z}"/></transform>'


def test_reads_prompts_base_and_region(make_scene: Make, animal: tuple[np.ndarray, np.ndarray]) -> None:
    path = make_scene()
    scene = load_edit_scene(path)
    assert (scene.prompt, scene.base_prompt, scene.negative_prompt) == ("a pig with two wings", "a pig", "")
    (mesh,) = scene.base
    assert mesh.name == "body" and mesh.source_files[0].read_bytes() == (path.parent / "animal.ply").read_bytes()
    assert mesh.vertices.dtype == np.float64 and np.allclose(mesh.vertices, animal[0], atol=1e-6)
    assert np.array_equal(mesh.faces, animal[1])
    (region,) = scene.regions
    assert region.name == "wing" and region.part == "part" and scene.parts == {"part": (region,)}
    assert [file.name for file in scene.files] == ["scene.xml", "animal.ply"]


def test_scene_is_frozen(make_scene: Make) -> None:
    scene = load_edit_scene(make_scene())
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.prompt = "other"  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        scene.base[0].vertices[0, 0] = 1.0


def test_frame_centres_and_scales_and_comes_back(make_scene: Make) -> None:
    base = BASE.replace("<bsdf", move("7", (100, -20, 3)) + "<bsdf")
    region = '<shape type="focal_region" id="wing">' + move("2", (100, -18, 3)) + "</shape>"
    scene = load_edit_scene(make_scene(base=base, region=region))
    canonical = scene.base_canonical.vertices
    low, high = canonical.min(axis=0), canonical.max(axis=0)
    assert np.allclose(low, -high, atol=1e-12) and np.isclose((high - low).max(), 1.8, atol=1e-12)
    back = scene.frame.to_user(scene.frame.to_canonical(scene.base[0].vertices))
    assert np.abs(back - scene.base[0].vertices).max() < 1e-12
    ball = scene.regions[0]
    assert np.allclose(scene.frame.to_user(ball.centre), [100, -18, 3], atol=1e-5)
    assert np.isclose(ball.size / scene.frame.scale, 4.0, atol=1e-5)


def test_normalisation_refuses_a_point() -> None:
    with pytest.raises(ValueError, match="extent"):
        Normalisation.of_points(np.ones((5, 3)))


@pytest.mark.parametrize(
    ("kind", "inner", "closed", "volume"),
    [
        ("cube", "", True, 8.0),
        ("sphere", '<float name="radius" value="0.5"/><point name="center" x="0.6" y="0.5" z="0"/>', True, 0.5236),
        ("cylinder", '<float name="radius" value="0.5"/><point name="p1" x="0" y="2" z="0"/>', False, None),
    ],
)
def test_mitsuba_shapes_become_triangles(
    make_scene: Make, kind: str, inner: str, closed: bool, volume: float | None
) -> None:
    region = f'<shape type="focal_region" id="r">{move("0.3", (0.5, 0.5, 0))}</shape>'
    (mesh,) = load_edit_scene(make_scene(base=shape(kind, inner), region=region)).base
    assert topology(mesh.vertices, mesh.faces).closed is closed and mesh.source_files == ()
    if volume is not None:
        assert np.isclose(mesh.volume(), volume, rtol=2e-3)


@pytest.mark.parametrize("scale", ["2", "-2"])
def test_mirrored_shapes_stay_outward(make_scene: Make, scale: str) -> None:
    for base in (
        shape("cube", move(scale)),
        BASE.replace("<bsdf", move(scale) + "<bsdf"),
        shape("sphere", move(scale)),
    ):
        (mesh,) = load_edit_scene(make_scene(base=base)).base
        assert mesh.volume() > 0


def test_flat_shapes_beside_a_solid_are_fine(make_scene: Make) -> None:
    flat = shape("rectangle", name="ground") + shape("disk", name="plate")
    named = INTEGRATOR.replace("<string", '<string name="base" value="plate, body, ground"/><string', 1)
    scene = load_edit_scene(make_scene(base=BASE + flat, integrator=named))
    assert [mesh.name for mesh in scene.base] == ["body", "ground", "plate"]
    assert len(scene.base_soup.faces) == sum(len(mesh.faces) for mesh in scene.base)


def test_obj_with_uv_seams_and_serialized_round_trip(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    vertices, faces = unit_sphere(3)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"vt {i / 7 % 1} {i / 3 % 1}" for i in range(3 * len(faces))]
    lines += [f"f {a + 1}/{3 * i + 1} {b + 1}/{3 * i + 2} {c + 1}/{3 * i + 3}" for i, (a, b, c) in enumerate(faces)]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    region = f'<shape type="focal_region" id="r">{move("0.3", (0, 1, 0))}</shape>'
    base = shape("obj", '<string name="filename" value="ball.obj"/>')
    (mesh,) = load_edit_scene(make_scene(base=base, region=region)).base
    found = topology(mesh.vertices, mesh.faces)
    assert len(mesh.vertices) == 3 * len(faces) and found.closed and found.components == 1
    assert found.duplicate_vertices == 3 * len(faces) - len(vertices)


def test_open_base_with_several_components(
    make_scene: Make, tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]
) -> None:
    path = make_scene()
    vertices, faces = animal
    faces = faces[vertices[faces][:, :, 1].mean(axis=1) < 0.25]
    write_ply(
        tmp_path / "animal.ply",
        np.concatenate([vertices, vertices + [2, 0, 0]]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    scene = load_edit_scene(path)
    found = topology(scene.base[0].vertices, scene.base[0].faces)
    assert not found.closed and found.components == 2


def test_several_regions_parts_and_mesh_regions(make_scene: Make, tmp_path: Path) -> None:
    vertices, faces = unit_sphere(2)
    write_ply(tmp_path / "ball.ply", vertices, faces)
    region = f"""<shape type="focal_region" id="a"><string name="part" value="hat"/>{move("0.2", (0, 0.4, 0.5))}</shape>
      <shape type="focal_region" id="b"><string name="part" value="wings"/>{move("0.2", (0.3, 0.2, 0))}</shape>
      <shape type="focal_region"><string name="part" value="wings"/><string name="filename" value="ball.ply"/>
        {move("0.2", (-0.3, 0.2, 0))}</shape>"""
    scene = load_edit_scene(make_scene(region=region))
    assert {name: [r.name for r in regions] for name, regions in scene.parts.items()} == {
        "hat": ["a"], "wings": ["b", "region_3"]
    }  # fmt: skip
    by_mesh = scene.regions[2]
    assert not by_mesh.is_ellipsoid
    assert np.allclose(scene.frame.to_user(by_mesh.centre), [-0.3, 0.2, 0], atol=1e-6)
    assert np.isclose(by_mesh.size, scene.regions[1].size, rtol=0.03)


def test_a_box_as_region_has_the_boxs_distance(make_scene: Make) -> None:
    """Turned and stretched: against the closed form in the box's own axes, inside positive."""
    turn = '<scale x="0.1" y="0.3" z="0.2"/><rotate x="1" angle="30"/><translate x="0.05" y="0.4" z="0"/>'
    inner = f'<string name="shape" value="box"/><transform name="to_world">{turn}</transform>'
    scene = load_edit_scene(make_scene(region=f'<shape type="focal_region" id="wing">{inner}</shape>'))
    (region,) = scene.regions
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    angle = np.deg2rad(30)
    axes = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    away = np.abs((scene.frame.to_user(points) - [0.05, 0.4, 0]) @ axes) - [0.1, 0.3, 0.2]
    outside = np.linalg.norm(away.clip(min=0), axis=1)
    expected = scene.frame.scale * np.where(away.max(axis=1) < 0, -away.max(axis=1), -outside)
    assert (expected > 0).any() and np.allclose(region.sdf(points), expected, atol=1e-6)
    assert region.volume == pytest.approx(8 * 0.1 * 0.3 * 0.2 * scene.frame.scale**3)
    assert region.thickness == pytest.approx(2 * 0.1 * scene.frame.scale, rel=0.1)


def test_a_bar_through_a_slab_touches_it(make_scene: Make) -> None:
    """No corner of either lies in the other: only what is between the corners meets."""
    slab = shape("cube", '<transform name="to_world"><scale x="1" y="0.1" z="1"/></transform>')
    inner = '<scale x="0.1" y="0.5" z="0.1"/>'
    region = f"""<shape type="focal_region" id="bar"><string name="shape" value="box"/>
      <transform name="to_world">{inner}</transform></shape>"""
    scene = load_edit_scene(make_scene(base=slab, region=region))
    canonical = scene.base_canonical
    distance = MeshDistance(canonical.vertices, canonical.faces)
    assert gap_to_base(scene.regions[0], distance, canonical) == 0


def test_a_cylinder_as_region_takes_its_property(make_scene: Make) -> None:
    volumes = {}
    for top in (1.0, 0.5):
        inner = f'<string name="shape" value="cylinder"/><float name="top" value="{top}"/>{move("0.2", (0, 0.4, 0))}'
        scene = load_edit_scene(make_scene(region=f'<shape type="focal_region" id="wing">{inner}</shape>'))
        volumes[top] = scene.regions[0].volume / scene.frame.scale**3
    assert volumes[1.0] == pytest.approx(2 * np.pi * 0.2**3, rel=1e-3)
    assert volumes[0.5] / volumes[1.0] == pytest.approx((1 + 0.5 + 0.25) / 3), "a truncated cone"


def test_parameters_fill_names_and_dollars_are_literal(make_scene: Make) -> None:
    integrator = '<integrator type="dual_path"><string name="prompt" value="$prompt"/></integrator>'
    extra = '<default name="prompt" value="a pig"/><default name="size" value="0.2"/>'
    region = f'<shape type="focal_region" id="r">{move("$size", (0, 0.3, 0))}</shape>'
    path = make_scene(integrator=integrator, extra=extra, region=region)
    assert load_edit_scene(path).prompt == "a pig"
    scene = load_edit_scene(path, {"prompt": "a pig worth $5 & <more>", "size": "0.3"})
    assert scene.prompt == "a pig worth $5 & <more>"
    assert np.isclose(scene.regions[0].size / scene.frame.scale, 0.6, atol=1e-6)
    assert scene.parameters == {"prompt": "a pig worth $5 & <more>", "size": "0.3"}


def test_include_in_the_folder_and_path_elements(make_scene: Make, tmp_path: Path) -> None:
    path = make_scene(extra='<path value="meshes"/>', light='<include filename="light.xml"/>')
    (tmp_path / "light.xml").write_text('<scene version="3.0.0"><emitter type="constant" id="light"/></scene>')
    (tmp_path / "meshes").mkdir()
    (tmp_path / "animal.ply").rename(tmp_path / "meshes" / "animal.ply")
    scene = load_edit_scene(path)
    assert [file.name for file in scene.files] == ["scene.xml", "light.xml", "animal.ply"]


def test_document_types_are_refused_and_nothing_is_expanded(make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("secret")
    bomb = '<!DOCTYPE s [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;"><!ENTITY f SYSTEM "secret.txt">]>\n'
    integrator = '<integrator type="dual_path"><string name="prompt" value="a &b; &f; pig"/></integrator>'
    path = make_scene(integrator=integrator)
    path.write_text(bomb + path.read_text())
    with pytest.raises(UserError, match=r"scene.xml:1: <!DOCTYPE>.*remove it"):
        load_edit_scene(path)


def test_mitsuba_reads_the_same_file(make_scene: Make, mi: Any) -> None:
    scene = mi.load_file(str(make_scene()), optimize=False)
    assert [shape.id() for shape in scene.shapes()] == ["body", "wing"]
    assert scene.integrator().prompt == "a pig with two wings"
    wing = scene.shapes()[1].bbox()
    assert np.allclose([np.array(wing.min), np.array(wing.max)], [[-0.12, 0.1, -0.15], [0.12, 0.6, 0.15]], atol=2e-3)


def test_plain_render_is_a_preview(make_scene: Make, mi: Any) -> None:
    camera = """<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>
      </transform>
      <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>"""
    scene = mi.load_file(str(make_scene(extra=camera)), optimize=False)
    image = np.array(mi.render(scene, spp=4))
    assert image.shape == (16, 16, 3) and np.isfinite(image).all() and image.std() > 0


def test_mitsuba_scene_can_leave_things_out_and_restores_the_search_path(make_scene: Make, mi: Any) -> None:
    before = [str(entry) for entry in mi.file_resolver()]
    scene = load_edit_scene(make_scene())
    assert [shape.id() for shape in scene.mitsuba_scene(without=("focal_region",)).shapes()] == ["body"]
    assert [str(entry) for entry in mi.file_resolver()] == before


def test_relative_scene_path(make_scene: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    make_scene()
    monkeypatch.chdir(tmp_path)
    assert load_edit_scene("scene.xml").base[0].source_files[0].is_file()


@pytest.mark.parametrize(("height", "expected"), [(0.0, 0.0), (1.0, 0.0), (1.5, 0.3), (3.0, 1.8)])
def test_gap_between_a_ball_and_a_region(height: float, expected: float) -> None:
    vertices, faces = unit_sphere(5)
    matrix = np.diag([0.2, 0.2, 0.2, 1.0])
    matrix[1, 3] = height
    region = FocalRegion("r", matrix)
    from fd_mitsuba.scene.triangle_mesh import TriangleMesh

    base = TriangleMesh("base", vertices, faces)
    assert gap_to_base(region, MeshDistance(vertices, faces), base) == pytest.approx(expected, abs=3e-3)


def test_share_in_grid_of_a_half_hidden_ball() -> None:
    matrix = np.diag([0.3, 0.3, 0.3, 1.0])
    assert share_in_grid(FocalRegion("r", matrix)) == 1.0
    matrix[0, 3] = 1.05
    assert share_in_grid(FocalRegion("r", matrix)) == pytest.approx(0.5, abs=0.02)
    matrix[0, 3] = 2.0
    assert share_in_grid(FocalRegion("r", matrix)) == 0.0


def test_a_tall_region_makes_room_for_itself(make_scene: Callable[..., Path]) -> None:
    def region(height: float, y: float) -> str:
        place = f'<scale x="0.1" y="{height}" z="0.1"/><translate y="{y}"/>'
        return f'<shape type="focal_region" id="r"><transform name="to_world">{place}</transform></shape>'

    plain = load_edit_scene(make_scene(region=region(0.1, 0.3)))
    paper = Normalisation.of_points(plain.base_soup.vertices)
    assert plain.frame.scale == paper.scale and np.array_equal(plain.frame.centre, paper.centre)
    assert not plain.has_headroom
    tall = load_edit_scene(make_scene(region=region(0.6, 0.8)))
    assert tall.has_headroom and share_in_grid(tall.regions[0]) == 1.0
    # What is said in the scene's units stays where it is.
    assert np.allclose(tall.frame.to_user(tall.regions[0].centre), [0, 0.8, 0])
    low, high = tall.base_soup.vertices.min(axis=0), np.maximum(tall.base_soup.vertices.max(axis=0), [-9, 1.4, -9])
    assert np.allclose(tall.frame.to_canonical(np.stack([low, high]))[:, 1], [-0.975, 0.975], atol=1e-3)
    with pytest.raises(UserError, match="lies in the editable cube"):  # a base of less than half its size
        load_edit_scene(make_scene(region=region(2.0, 2.2)))
