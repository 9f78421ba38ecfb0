"""`fd_mitsuba export` on run folders: finished, interrupted, damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.runs.run_folder import describe_run
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.training.checkpoint import CheckpointHeader, checkpoint_folder, list_checkpoints, save_checkpoint
from fd_mitsuba.training.geometry_stage import GeometryStage

Make = Callable[..., Path]


@pytest.fixture
def run_folder(make_scene: Make, tmp_path: Path) -> Path:
    """A run that was interrupted after its first checkpoint; the part is still the region."""
    scene = load_edit_scene(make_scene())
    config = RunConfig.load(None, ["geometry.grid_resolution=16", "geometry.lambda_sds=0"])
    folder = tmp_path / "run"
    describe_run(scene, config, folder, "fd_mitsuba run scene.xml")
    stage = GeometryStage(scene, config, None)
    header = CheckpointHeader(stage.name, 3, config.content_hash(stage.name), counters=dict(stage.counters))
    save_checkpoint(checkpoint_folder(folder, stage.name), header, stage.field, stage.optimiser, keep=2)
    return folder


def test_interrupted_run_is_exported(run_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run_folder), "--texture-size", "64", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["base_identical"] and written["part_faces"]["part"] > 100
    for name in written["files"]:
        assert (run_folder / "export" / name).is_file()
    assert (run_folder / "export" / "base" / "animal.ply").is_file()


def test_one_format(run_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run_folder), "--format", "glb", "ply"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        str(run_folder / "export" / "asset.glb"),
        str(run_folder / "export" / "ply" / "part_part.ply"),
    ]
    assert not (run_folder / "export" / "mitsuba").exists()


def test_levels_of_detail_are_assets_of_their_own(run_folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    options = ["--format", "glb", "mitsuba", "--texture-size", "64", "--json"]
    assert main(["export", str(run_folder), "--faces", "200,600", *options]) == 0
    out, lines = capfd.readouterr()
    written, export = json.loads(out), run_folder / "export"
    assert written["part_faces"]["part"] <= 600 and written["levels"]["lod_200"]["part"] <= 200
    assert {"asset.glb", "lod_200/asset.glb"} <= set(written["files"])
    assert (export / "lod_200" / "asset.glb").stat().st_size < (export / "asset.glb").stat().st_size
    for faces in (600, 200):
        assert sum(f"--faces {faces}: part 'part' has" in line for line in lines.splitlines()) == 1
    # What is exported anew after a change of the parts has the same levels.
    record = json.loads((export / "mitsuba" / "stack.json").read_text())["export"]
    assert record["faces"] == 600 and record["levels"] == [200]
    assert main(["export", str(run_folder), "--faces", "200", "many"]) == 1
    assert "--faces many" in capfd.readouterr().err


def test_what_cannot_be_exported_is_one_line(run_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    def complaint(folder: Path) -> str:
        assert main(["export", str(folder)]) == 1
        return capfd.readouterr().err

    assert "no such run folder" in complaint(tmp_path / "nowhere")
    assert "not a run" in complaint(tmp_path)
    scene, copy = tmp_path / "scene.xml", run_folder / "scene" / "scene.xml"
    text = scene.read_text()
    for path in (scene, copy):
        path.write_text(text.replace('value="0.5"', 'value="0.6"'))
    assert "was changed, too; put the scene back" in complaint(run_folder)
    for path in (scene, copy):
        path.unlink()
    assert "the run's scene is gone" in complaint(run_folder)
    scene.write_text(text)
    settings = run_folder / "config.json"
    before = settings.read_text()
    settings.write_text(json.dumps({**json.loads(before), "unknown": 1}))
    assert "another version" in complaint(run_folder)
    settings.write_text(before)
    for path in list_checkpoints(run_folder / "checkpoints"):
        path.unlink()
    assert "no checkpoint; run the geometry stage first" in complaint(run_folder)


def test_a_run_folder_is_enough_for_an_export(run_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    """Moved away from its scene, which is gone: the same files, and a line that says what was read."""
    assert main(["export", str(run_folder)]) == 0
    names = [path for path in sorted((run_folder / "export").rglob("*")) if path.is_file()]
    before = {path.relative_to(run_folder): path.read_bytes() for path in names}
    moved = tmp_path / "far" / "away"
    moved.parent.mkdir()
    run_folder.rename(moved)
    for name in ("scene.xml", "animal.ply"):
        (tmp_path / name).unlink()
    for name in ("asset.glb", "obj/asset.obj", "ply/part_part.ply", "mitsuba/scene.xml"):
        (moved / "export" / name).unlink()
    capfd.readouterr()
    assert main(["export", str(moved)]) == 0
    said = capfd.readouterr().err
    assert f"taking the copy of it in {moved / 'scene'}" in said
    assert {name: (moved / name).read_bytes() for name in before} == before
