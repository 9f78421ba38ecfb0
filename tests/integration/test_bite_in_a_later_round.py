"""Wings in a first round, a bite in a second: out of the body, or out of the wings themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from test_two_rounds import first, of_part  # noqa: F401

from fd_mitsuba.config import RunConfig
from fd_mitsuba.runs.parts import list_parts
from fd_mitsuba.runs.pipeline import export_run, run
from fd_mitsuba.scene.load_scene import load_edit_scene

BITE = """<scene version="3.0.0"><shape type="focal_region" id="bite"><string name="part" value="bite"/>
  <string name="mode" value="subtract"/><transform name="to_world">
  <scale value="{size}"/><translate x="0" y="{y}" z="{z}"/></transform></shape></scene>"""


@pytest.mark.parametrize(("where", "y", "z"), [("body", 0.0, 0.5), ("wings", 0.62, 0.0)])
def test_a_bite(
    first: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
    y: float,
    z: float,
) -> None:
    monkeypatch.setattr("fd_mitsuba.runs.geometry_outcome._write_turntable", lambda *_: None)
    regions, folder = tmp_path / "bite.xml", tmp_path / "run"
    regions.write_text(BITE.format(size=0.12, y=y, z=z))
    scene = load_edit_scene(first / "mitsuba" / "scene.xml", regions=regions, prompt="a pig with a bite")
    assert scene.subtracts and [part.name for part in scene.earlier] == ["wings"]
    config = RunConfig.load(first.parent / "tiny.toml", ["geometry.steps=1"])
    metrics = run(scene, config, folder, quiet=True, say=lambda line: None, stages=("geometry",))
    assert metrics["base_identical"] and metrics["removed_volume"] > 0 and metrics["volume_change_error"] < 1e-3
    export_run(folder, ("glb", "ply", "mitsuba"), 64, say=lambda line: None)
    export = folder / "export"
    nodes = pygltflib.GLTF2().load(export / "asset.glb").nodes
    assert [node.name for node in nodes] == ["base", "part_wings"]
    assert [(part.name, part.round) for part in list_parts(folder)] == [("wings", 1)]
    before = of_part(first / "mitsuba", "wings")
    bitten = {"body": "cut_body.ply", "wings": "cut_part_wings.ply"}
    other = next(name for key, name in bitten.items() if key != where)
    assert (export / bitten[where]).is_file() and not (export / other).exists()
    after = of_part(export / "mitsuba", "wings")
    if where == "body":
        assert after == before and len(before) == 6
        return
    # The wings have a new mesh and their own pictures; the body's file is what it was.
    assert {name: data for name, data in before.items() if not name.endswith(".ply")}.items() <= after.items()
    wings = trimesh.load(export / "cut_part_wings.ply", process=False)
    assert np.isclose(wings.vertices[:, 1].min(), 0.1, atol=0.02) and wings.vertices[:, 1].max() < 0.6
