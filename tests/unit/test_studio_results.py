"""What the studio shows of a run: the growing mesh, the GLB of the part alone, runs from elsewhere, another round."""

from __future__ import annotations

import io
import json
import signal
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.gltf import GltfMesh, glb_bytes
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.io.ply import ply_bytes, read_ply
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.studio import checks as checking
from fd_mitsuba.studio import runner
from fd_mitsuba.studio.adopted_run import adopt
from fd_mitsuba.studio.base_glb import base_glb, only_parts
from fd_mitsuba.studio.job import EventReader, EventWriter, RunOrder
from fd_mitsuba.studio.live_check import LiveCheck
from fd_mitsuba.studio.live_part import live_part
from fd_mitsuba.studio.opening import open_target
from fd_mitsuba.studio.results import download, shown_part
from fd_mitsuba.studio.run_state import FINISHED, STOPPED, RunState
from fd_mitsuba.studio.session import Session
from fd_mitsuba.studio.settings import StudioSettings

FRAME = Normalisation(np.array([1.0, 2.0, 3.0]), 0.5)
BALL, FACES = unit_sphere(2)
PLAIN = """<scene version="3.0.0">
  <integrator type="path"/>
  <!-- exported -->
  <shape type="ply" id="body"><string name="filename" value="animal.ply"/><bsdf type="diffuse"/></shape>
  <shape type="sphere" id="part_part"><float name="radius" value="0.1"/>
    <transform name="to_world"><translate y="0.4"/></transform></shape>
</scene>
"""


def asset() -> bytes:
    meshes = [
        GltfMesh(name, (1 + i) * BALL, FACES, PbrMaterial(name))
        for i, name in enumerate(("base", "part_hat", "part_x"))
    ]
    return glb_bytes(meshes, {})


def finished_run(folder: Path) -> RunState:
    (folder / "export").mkdir(parents=True)
    (folder / "export" / "asset.glb").write_bytes(asset())
    (folder / "export" / "part_hat.ply").write_bytes(ply_bytes(2 * BALL, FACES))
    (folder / "metrics.json").write_text('{"stages": {}}')
    return RunState(folder).settled()


def test_glb_of_the_part_alone() -> None:
    shown = trimesh.load(io.BytesIO(only_parts(asset(), ["hat"])), file_type="glb")
    assert list(shown.graph.nodes_geometry) == ["part_hat"] and shown.extents == pytest.approx([4, 4, 4], abs=0.1)


def test_base_glb_has_analytic_shapes_and_places(make_scene, mi) -> None:
    centre = '<point name="center" x="3" y="0" z="0"/>'
    ball = f'<shape type="sphere" id="ball"><float name="radius" value="0.5"/>{centre}</shape>'
    scene = load_edit_scene(make_scene(extra=ball))
    found = trimesh.load(io.BytesIO(base_glb(scene)), file_type="glb")
    bounds = np.concatenate([mesh.vertices for mesh in scene.base])
    assert found.bounds == pytest.approx(np.stack([bounds.min(axis=0), bounds.max(axis=0)]), abs=1e-5)
    assert found.bounds[1, 0] == pytest.approx(3.5, abs=0.01)


def test_what_is_shown_follows_the_run(tmp_path: Path) -> None:
    events, run = EventWriter(tmp_path), RunState(tmp_path)
    assert shown_part(run, FRAME) is None
    run.live_mesh.write_bytes(ply_bytes(BALL, FACES))
    events.write("mesh", step=10, faces=len(FACES))
    run.follow()
    live = shown_part(run, FRAME)
    assert live is not None and live.glb is None
    assert live.vertices == pytest.approx(0.5 * (BALL - [1, 2, 3]), abs=1e-6)
    done = shown_part(finished_run(tmp_path / "b"), FRAME)
    assert done is not None and done.glb is not None and not done.whole and done.key != live.key
    assert np.ptp(done.vertices) > np.ptp(live.vertices)


def test_downloads(tmp_path: Path) -> None:
    run = finished_run(tmp_path / "a")
    assert run.state == FINISHED and download(run, "GLB") == ("part_a.glb", asset())
    (run.folder / "export" / "obj").mkdir()
    (run.folder / "export" / "obj" / "asset.obj").write_text("v 0 0 0")
    name, data = download(run, "OBJ")
    assert name == "part_a_obj.zip" and zipfile.ZipFile(io.BytesIO(data)).namelist() == ["asset.obj"]
    with pytest.raises(UserError, match="mitsuba: is not there"):
        download(run, "Mitsuba scene")
    with pytest.raises(UserError, match="has no result yet"):
        download(RunState(tmp_path / "none"), "GLB")


def test_live_part_is_the_region_at_the_start(make_scene, mi) -> None:
    from fd_mitsuba.training.geometry_stage import GeometryStage

    scene = load_edit_scene(make_scene())
    stage = GeometryStage(scene, RunConfig.load("smoke", ["geometry.union_k=0"]), None)
    vertices, faces = live_part(stage)
    distance = np.abs(scene.regions[0].sdf(scene.frame.to_canonical(vertices)))
    assert len(faces) > 50 and faces.max() == len(vertices) - 1
    assert np.median(distance) < 0.01 and distance.max() < 2.1 / 24


def test_live_material_is_what_the_field_says(make_scene, mi, tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene())
    canonical = 0.2 * BALL + [0.0, 0.6, 0.0]

    def field(points: torch.Tensor) -> SimpleNamespace:
        one = torch.ones(len(points), 1)
        return SimpleNamespace(base_color=points + 0.3, roughness=0.25 * one, metallic=0.75 * one)

    parts = {"hat": SimpleNamespace(vertices=canonical, faces=FACES)}
    config = RunConfig.load("smoke")
    stage = SimpleNamespace(scene=scene, config=config, parts=parts, field=field)
    run = RunState(tmp_path / "run")
    events = EventWriter(run.folder)
    runner._Material().write(stage, run.folder)
    (run.folder / "export").mkdir()
    (run.folder / "export" / "part_hat.ply").write_bytes(ply_bytes(scene.frame.to_user(canonical), FACES))
    events.write("step", stage="appearance", phase="appearance", step=3, total=9)
    run.follow()
    bare = shown_part(run, scene.frame)
    assert bare is not None and bare.glb is None  # the shape is ready, and nothing is learned yet
    events.write("material", step=3)
    run.follow()
    shown = shown_part(run, scene.frame)
    assert shown is not None and shown.glb is not None and shown.key != bare.key
    (tmp_path / "shown.glb").write_bytes(shown.glb)
    asset = read_asset(tmp_path / "shown.glb")
    (mesh,) = asset.meshes
    assert np.allclose(mesh.placed()[0], scene.frame.to_user(canonical), atol=1e-6)
    assert mesh.colours is not None and np.allclose(mesh.colours, (canonical + 0.3).clip(0, 1), atol=1e-6)
    assert (asset.materials[0].roughness, asset.materials[0].metallic) == (0.25, 0.75)


def test_runner_tells_what_a_run_does(make_scene, mi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fd_mitsuba as fd
    from fd_mitsuba.training.geometry_stage import GeometryStage
    from fd_mitsuba.training.stage import StepUpdate

    run = tmp_path / "runs" / "001"
    RunOrder("../../scene.xml", "a pig with a horn", RunConfig.load("smoke").model_dump(mode="json")).write(run)
    scene = load_edit_scene(make_scene())
    stage = GeometryStage(scene, RunConfig.load("smoke"), None)
    given = {}

    def edit(scene, config, *, on_step, log, **options) -> None:
        given.update(options, config=config)
        log("prompt read")
        for step in range(1, 13):
            values = {"loss_sds": step / 3, "part_faces": 9.0}
            on_step(StepUpdate("geometry", "coarse", step, 12, values, stage))

    monkeypatch.setattr(fd, "load_scene", lambda path, *_, prompt, **__: given.update(prompt=prompt, scene=path))
    monkeypatch.setattr(fd, "edit", edit)
    monkeypatch.setattr(runner, "_stop_on_signals", lambda events: None)
    parents = iter([1, 1, 1])
    monkeypatch.setattr(runner.os, "getppid", lambda: next(parents, 2))  # the studio is gone after two steps
    signals = []
    monkeypatch.setattr(runner.os, "kill", lambda process, number: signals.append(number))
    assert runner.main([str(run)]) == 0
    rows = list(EventReader(run).new())
    assert [row["step"] for row in rows if row["event"] == "mesh"] == [1, 10, 12]
    assert [row["event"] for row in rows[:2]] == ["begun", "said"] and rows[-1]["event"] == "finished"
    assert rows[2]["losses"] == {"loss_sds": 0.33333}
    assert given["prompt"] == "a pig with a horn" and given["output"] == run and given["resume"] is False
    assert len(read_ply(run / "live" / "part.ply")[1]) == rows[-2]["faces"]
    assert signals == [signal.SIGTERM]
    (run / "live" / "job.json").unlink()
    assert runner.main([str(run)]) == 1
    assert "job.json: is missing or damaged" in list(EventReader(run).new())[-1]["line"]


def test_run_from_elsewhere_is_shown_and_gone_on_with(make_scene, mi, tmp_path: Path) -> None:
    scene, run = make_scene(), tmp_path / "mine"
    config = RunConfig.load("smoke", ["seed=7"]).model_dump(mode="json")
    run.mkdir()
    (run / "run.json").write_text(
        json.dumps({"scene": "../scene.xml", "prompt": "a pig with a horn", "parameters": {}})
    )
    (run / "config.json").write_text(json.dumps(config))
    (run / "metrics.jsonl").write_text('{"stage": "geometry", "phase": "coarse", "step": 3, "seconds": 1}\n')
    session = Session(
        opened_with(scene, tmp_path / "work", run), StudioSettings("smoke"), program=(sys.executable, "-I", "-c", "")
    )
    found = session.queue.runs["mine"]
    assert (found.state, found.step, found.total, found.seed) == (STOPPED, 3, 4, 7) and session.shown == "mine"
    session.queue.resume("mine")
    order = RunOrder.read(run)
    assert order.resume and order.prompt == "a pig with a horn" and (run / order.scene).resolve() == scene.resolve()
    session.close()
    again = Session(open_target(tmp_path / "work", None, {}), StudioSettings(), say=lambda line: None)
    assert list(again.queue.runs) == ["mine"]
    again.close()
    with pytest.raises(UserError, match="is no run of a single scene file"):
        adopt(tmp_path / "work")


def opened_with(scene: Path, work: Path, run: Path):
    from dataclasses import replace

    return replace(open_target(scene, work, {}, say=lambda line: None), shown=run.name, run=run)


def test_edit_again_makes_the_result_the_base(make_scene, mi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "live_check", lambda scene, config: LiveCheck())
    opened = open_target(make_scene(), tmp_path / "work", {}, say=lambda line: None)
    session = Session(opened, StudioSettings("smoke"), program=(sys.executable, "-I", "-c", ""))
    name = session.grow()
    export = session.queue.runs[name].folder / "export" / "mitsuba"
    export.mkdir(parents=True)
    (export / "scene.xml").write_text(PLAIN)
    (export / "animal.ply").write_bytes((tmp_path / "animal.ply").read_bytes())
    topics: list[str] = []
    session.subscribe(topics.append)
    session.edits.set_prompt("a pig with a tail")
    session.edit_again(name)
    state = session.state
    assert topics[-1] == "scene" and session.shown == "" and state.prompt == "a pig with a tail"
    assert [mesh.name for mesh in state.scene.base] == ["body", "part_part"]
    assert state.scene.base_prompt == "a pig with two wings"
    assert [pose.part for pose in state.regions.poses.values()] == ["part_2"]
    assert session.save_scene() == "scene_2/scene.xml has all that already"
    assert b"<!-- exported -->" in (tmp_path / "work" / "scene_2" / "scene.xml").read_bytes()
    second = session.grow()
    session.close()
    again = Session(open_target(tmp_path / "work", None, {}), StudioSettings(), say=lambda line: None)
    assert again.state.source.round == 2 and list(again.queue.runs) == [name, second]
    assert RunOrder.read(again.queue.runs[second].folder).scene == "../../scene_2/run_002.xml"
    again.close()
