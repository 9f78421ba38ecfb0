"""A part placed many times in a GLB: one mesh, every copy where its matrix says, read back by another library."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from viewer_setup import glb_faults, needs_validator

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.gltf import GltfMesh, glb_bytes
from fd_mitsuba.export.instance_glb import instance_glb
from fd_mitsuba.export.instances import Placement, write_instances
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.scene.tessellate import unit_sphere

TURNED = np.array([[0.0, -2, 0, 5], [2, 0, 0, 0], [0, 0, 3, 1], [0, 0, 0, 1]])
SHEARED = np.array([[1.0, 0.8, 0, 0], [0, 1, 0, 4], [0.3, 0, 1, 0], [0, 0, 0, 1]])
MIRRORED = np.diag([-1.0, 1, 1, 1])


def asset(several: bool = False, metres: float | None = None) -> bytes:
    """A base, two shapes below one node if `several`, with places of their own, and a hat at (1, 2, 3)."""
    vertices, faces = unit_sphere(1)
    place = np.array([[0.0, 0, 1.5, 1], [0, 1.5, 0, 0], [-1.5, 0, 0, 0], [0, 0, 0, 1]])
    names = ("base_a", "base_b") if several else ("base",)
    base = [
        GltfMesh(name, vertices + 4 * i, faces, PbrMaterial(name), to_world=place, parent="base" if several else "")
        for i, name in enumerate(names)
    ]
    hat = GltfMesh("part_hat", 0.5 * vertices + [1, 2, 3], faces, PbrMaterial("part_hat"), extras={"part": "hat"})
    return glb_bytes([*base, hat], {"prompt": "a ball with a hat"}, metres)


def world(data: bytes) -> dict[str, np.ndarray]:
    """Name of each node with a mesh -> its vertices where the file puts them."""
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    found = {}
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[name]
        found[name] = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
    return found


@pytest.mark.parametrize("several", [False, True])
def test_every_copy_is_where_its_matrix_says(several: bool) -> None:
    before = asset(several)
    places = [
        Placement("hat", TURNED),
        Placement("hat", SHEARED, base=True),
        Placement("hat", MIRRORED @ SHEARED, base=True),
    ]
    after = instance_glb(before, places)
    old, new = world(before), world(after)
    for count, place in enumerate(places, 1):
        wanted = trimesh.transform_points(old["part_hat"], place.to_world)
        assert np.allclose(new[f"part_hat_{count}"], wanted, atol=1e-5)
    for name in [name for name in old if name.startswith("base")]:
        for count, place in enumerate(places[1:], 1):
            assert np.allclose(new[f"{name}_{count}"], trimesh.transform_points(old[name], place.to_world), atol=1e-5)
    assert len(new) == 3 + 2 * (2 if several else 1)
    small = world(instance_glb(asset(several, 0.01), places))  # placements are in the scene's unit, the file in metres
    assert small.keys() == new.keys()
    assert all(np.allclose(small[name], 0.01 * new[name], atol=1e-6) for name in new)
    file = pygltflib.GLTF2.load_from_bytes(after)
    assert len(file.meshes) == len(old) and len(file.scenes[0].nodes) == 5
    assert len(after) - len(before) < 4000  # no vertex is there twice
    assert file.scenes[0].extras == {"prompt": "a ball with a hat"}


def test_what_is_not_placed_stays() -> None:
    new = world(instance_glb(asset(), [Placement("hat", TURNED)]))
    assert set(new) == {"base", "part_hat_1"} and np.array_equal(new["base"], world(asset())["base"])
    with pytest.raises(UserError, match="'part_wing'"):
        instance_glb(asset(), [Placement("wing", TURNED)])


def test_it_goes_beside_the_exported_glb(tmp_path: Path) -> None:
    folder = tmp_path / "export" / "mitsuba"
    folder.mkdir(parents=True)
    (folder / "scene.xml").write_text('<scene version="3.0.0"><shape type="sphere" id="part_hat"/></scene>')
    anchor = {"position": [1, 1.5, 3], "direction": [0, 1, 0]}
    (tmp_path / "export" / "part.json").write_text(json.dumps({"parts": {"hat": {"anchor": anchor}}}))
    (tmp_path / "places.json").write_text(json.dumps([{"position": [0, 0, 0]}, {"position": [9, 0, 0], "scale": 2}]))
    assert len(write_instances(tmp_path, tmp_path / "places.json", "many.xml")) == 1
    (tmp_path / "export" / "asset.glb").write_bytes(asset())
    scene, glb = write_instances(tmp_path, tmp_path / "places.json", "many.xml")
    assert scene == folder / "many.xml" and glb == tmp_path / "export" / "many.glb"
    assert world(glb.read_bytes())["part_hat_2"].min(axis=0) == pytest.approx([8, 0, -1], abs=1e-5)


@needs_validator
def test_the_validator_has_nothing_to_say(tmp_path: Path) -> None:
    places = [Placement("hat", TURNED), Placement("hat", MIRRORED @ SHEARED, base=True)]
    for name, several in (("one.glb", False), ("several.glb", True)):
        (tmp_path / name).write_bytes(instance_glb(asset(several), places))
    assert glb_faults(tmp_path / "one.glb", tmp_path / "several.glb") == {}
