"""Run folders: which may be used, what marks a run as another one, what is written down."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import trimesh
from conftest import BASE, write_ply

from fd_mitsuba.backend import threads
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import Interrupted, RunStopped, UserError
from fd_mitsuba.runs.run_folder import check_folder, describe_run, discarded_without_checkpoint, identity
from fd_mitsuba.runs.run_lock import LOCK_NAME
from fd_mitsuba.runs.saved_run import saved_run
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene

Make = Callable[..., Path]
CONFIG = RunConfig()
LITTER = ".run.json.4711.tmp"


@pytest.fixture
def scene(make_scene: Make) -> EditScene:
    return load_edit_scene(make_scene())


def test_new_empty_and_littered_folders_are_free(scene: EditScene, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    check_folder(scene, CONFIG, folder, resume=False)
    assert not folder.exists()
    folder.mkdir()
    check_folder(scene, CONFIG, folder, resume=False)
    (folder / LITTER).write_text("{")  # killed within its very first write
    check_folder(scene, CONFIG, folder, resume=False)
    describe_run(scene, CONFIG, folder, "command")
    assert not (folder / LITTER).exists()


def test_killed_after_any_of_the_first_writes(scene: EditScene, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    describe_run(scene, CONFIG, folder, "first")
    for path in [path for path in folder.rglob("*") if path.is_file() and path.name != "run.json"]:
        path.unlink()
        check_folder(scene, CONFIG, folder, resume=True)
    describe_run(scene, CONFIG, folder, "again")
    assert (folder / "scene" / "animal.ply").exists() and (folder / "command.txt").read_text() == "again\n"


def test_needs_resume(scene: EditScene, tmp_path: Path) -> None:
    describe_run(scene, CONFIG, tmp_path / "out", "command")
    with pytest.raises(UserError, match="add --resume"):
        check_folder(scene, CONFIG, tmp_path / "out", resume=False)
    check_folder(scene, CONFIG, tmp_path / "out", resume=True)


def test_every_changed_setting_is_named(scene: EditScene, tmp_path: Path) -> None:
    describe_run(scene, CONFIG, tmp_path / "out", "command")
    other = RunConfig.load(None, ["geometry.steps=5", "seed=2"])
    with pytest.raises(UserError, match=r"seed = 0, now 2; geometry.steps = 3000, now 5"):
        check_folder(scene, other, tmp_path / "out", resume=True)


def test_settings_that_change_no_result_may_change_and_are_told(scene: EditScene, tmp_path: Path) -> None:
    describe_run(scene, CONFIG, tmp_path / "out", "command")
    assert check_folder(scene, CONFIG, tmp_path / "out", resume=True) == []
    other = RunConfig.load(None, ["guidance.views_per_call=1", "output.texture_size=64", "guidance.device=cuda"])
    (line,) = check_folder(scene, other, tmp_path / "out", resume=True)
    assert "guidance.views_per_call = 1 (was 4)" in line and "output.texture_size = 64 (was 1024)" in line
    assert "guidance.device = cuda (was cpu)" in line
    with pytest.raises(UserError, match=r"other settings \(seed = 0, now 1\)"):
        check_folder(scene, RunConfig.load(None, ["seed=1", "output.texture_size=64"]), tmp_path / "out", resume=True)


def test_material_settings_count_once_the_material_has_begun(scene: EditScene, tmp_path: Path) -> None:
    """Until then another material may be asked for; afterwards nothing is written before that is refused."""
    folder, other = tmp_path / "out", RunConfig.load(None, ["appearance.steps=7", "texture.levels=3"])
    describe_run(scene, CONFIG, folder, "command")
    check_folder(scene, other, folder, resume=True)
    (folder / "checkpoints_appearance").mkdir()
    (folder / "checkpoints_appearance" / "step_000001.safetensors").write_text("")
    with pytest.raises(UserError, match=r"texture.levels = 12, now 3; appearance.steps = 2000, now 7"):
        check_folder(scene, other, folder, resume=True)


def test_what_cannot_be_read_of_the_settings_does_not_stop_a_resume(scene: EditScene, tmp_path: Path) -> None:
    describe_run(scene, CONFIG, tmp_path / "out", "command")
    for text in ("", "[]", '{"seed": "x"}', "[" * 100_000):
        (tmp_path / "out" / "config.json").write_text(text)
        assert check_folder(scene, CONFIG, tmp_path / "out", resume=True) == []
        with pytest.raises(UserError, match=r"other settings \(unknown\)"):
            check_folder(scene, RunConfig.load(None, ["seed=1"]), tmp_path / "out", resume=True)


def test_the_lock_of_a_killed_run_does_not_take_a_folder(scene: EditScene, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LOCK_NAME).write_text('{"process": 1')
    assert check_folder(scene, CONFIG, tmp_path / "out", resume=False) == []


def test_threads_in_the_record_are_those_of_the_run(scene: EditScene, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(threads, "_cores", 5)
    describe_run(scene, CONFIG, tmp_path / "out", "command")
    assert json.loads((tmp_path / "out" / "environment.json").read_text())["threads"] == 5


def test_changed_mesh_is_another_scene(make_scene: Make, tmp_path: Path) -> None:
    path = make_scene()
    describe_run(load_edit_scene(path), CONFIG, tmp_path / "out", "command")
    mesh = tmp_path / "animal.ply"
    mesh.write_text(mesh.read_text().replace("-0.", "-0.0", 1))
    with pytest.raises(UserError, match="a file of the scene was changed"):
        check_folder(load_edit_scene(path), CONFIG, tmp_path / "out", resume=True)


def test_moved_scene_is_the_same(make_scene: Make, tmp_path: Path) -> None:
    path = make_scene()
    describe_run(load_edit_scene(path), CONFIG, tmp_path / "out", "command")
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("scene.xml", "animal.ply"):
        (tmp_path / name).rename(moved / name)
    check_folder(load_edit_scene(moved / "scene.xml"), CONFIG, tmp_path / "out", resume=True)


def test_parameters_belong_to_the_run(make_scene: Make, tmp_path: Path) -> None:
    path = make_scene(
        extra='<default name="words" value="a pig with wings"/>',
        integrator='<integrator type="dual_path"><string name="prompt" value="a pig"/>'
        '<string name="base_prompt" value="$words"/></integrator>',
    )
    describe_run(load_edit_scene(path, {"words": "x"}), CONFIG, tmp_path / "out", "command")
    check_folder(load_edit_scene(path, {"words": "x"}), CONFIG, tmp_path / "out", resume=True)
    with pytest.raises(UserError, match="other parameters"):
        check_folder(load_edit_scene(path, {"words": "y"}), CONFIG, tmp_path / "out", resume=True)


ERRORS = [UserError("no"), RunStopped("no"), OSError(28, "no space"), RuntimeError("odd"), MemoryError(), KeyError()]


@pytest.mark.parametrize("error", ERRORS)
def test_error_before_the_first_checkpoint_leaves_nothing(scene: EditScene, tmp_path: Path, error: Exception) -> None:
    folder = tmp_path / "out"
    with pytest.raises(type(error)), discarded_without_checkpoint(folder):
        describe_run(scene, CONFIG, folder, "command")
        (folder / "metrics.jsonl").write_text("{}")
        (folder / ".step_000001.safetensors.1.tmp").write_text("")
        raise error
    assert not folder.exists()


def test_error_in_a_folder_with_files_of_others_takes_only_the_runs(scene: EditScene, tmp_path: Path) -> None:
    with pytest.raises(UserError), discarded_without_checkpoint(tmp_path):
        describe_run(scene, CONFIG, tmp_path, "command")
        (tmp_path / "thesis.tex").write_text("precious")
        raise UserError("no")
    assert (tmp_path / "thesis.tex").exists() and not (tmp_path / "run.json").exists()


@pytest.mark.parametrize("error", [RunStopped("it vanished; do less"), Interrupted("SIGINT"), UserError("full")])
def test_error_after_a_checkpoint_leaves_the_run(scene: EditScene, tmp_path: Path, error: Exception) -> None:
    folder = tmp_path / "out"
    with pytest.raises(type(error)) as caught, discarded_without_checkpoint(folder):
        describe_run(scene, CONFIG, folder, "command")
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "step_000100.safetensors").write_text("")
        raise error
    check_folder(scene, CONFIG, folder, resume=True)
    words = f"it vanished; do less; {folder} keeps the state after step 100: "
    assert str(caught.value).startswith(words if isinstance(error, RunStopped) else str(error))


def test_interrupted_before_the_first_checkpoint_can_be_resumed(scene: EditScene, tmp_path: Path) -> None:
    with pytest.raises(Interrupted), discarded_without_checkpoint(tmp_path / "out"):
        describe_run(scene, CONFIG, tmp_path / "out", "command")
        raise Interrupted("SIGINT")
    check_folder(scene, CONFIG, tmp_path / "out", resume=True)


def test_a_copy_is_a_scene_of_its_own_and_keeps_no_path(tmp_path: Path, make_scene: Make) -> None:
    """Files of one name in several places, one of them by its whole path, one through a link: all are kept."""
    path = make_scene()
    place, outside = tmp_path / "deep" / "scene", tmp_path / "animal.ply"
    for folder in ("deep/scene/meshes", "other"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "animal.ply").write_bytes(outside.read_bytes() + b"\n" * len(folder))
    (place / "link.ply").symlink_to(outside)
    names = ["meshes/animal.ply", "../../animal.ply", str(tmp_path / "other" / "animal.ply"), "link.ply"]
    shapes = "".join(
        f'<shape type="ply" id="s{number}"><string name="filename" value="{name}"/></shape>'
        for number, name in enumerate(names)
    )
    (place / "scene.xml").write_text(path.read_text().replace(BASE, shapes))
    scene = load_edit_scene(place / "scene.xml")
    out = tmp_path / "out"
    describe_run(scene, CONFIG, out, "command")
    copies = out / "scene"
    assert sorted(str(file.relative_to(copies)) for file in copies.rglob("*") if file.is_file()) == [
        "elsewhere/2/animal.ply",
        "elsewhere/animal.ply",
        "elsewhere/names.json",
        "link.ply",
        "meshes/animal.ply",
        "scene.xml",
    ]
    known = json.loads((out / "run.json").read_text())
    assert known["scene"] == "../deep/scene/scene.xml"
    assert known["copy"] == {"scene": "scene/scene.xml", "regions": None}
    # Moved and without the originals, it is the same scene.
    moved = tmp_path / "far" / "away"
    moved.mkdir(parents=True)
    out.rename(moved / "out")
    for folder in (tmp_path / "deep", tmp_path / "other"):
        shutil.rmtree(folder)
    outside.unlink()
    copied = load_edit_scene(moved / "out" / "scene" / "scene.xml")
    assert identity(copied, CONFIG, out)["scene_hash"] == known["scene_hash"]
    assert [len(mesh.faces) for mesh in copied.base] == [len(mesh.faces) for mesh in scene.base]
    copied.mitsuba_scene()
    check_folder(copied, CONFIG, moved / "out", resume=True)
    # And a copy of the copy, too.
    describe_run(copied, CONFIG, tmp_path / "third", "command")
    again = load_edit_scene(tmp_path / "third" / "scene" / "scene.xml")
    assert identity(again, CONFIG, out)["scene_hash"] == known["scene_hash"]


def test_regions_in_a_file_of_another_folder_are_copied_with_their_mesh(tmp_path: Path, make_scene: Make) -> None:
    path = make_scene(region="")
    other = tmp_path / "regions"
    other.mkdir()
    ball = trimesh.creation.icosphere(2, 0.15)
    write_ply(tmp_path / "ball.ply", ball.vertices, ball.faces)
    region = (
        '<shape type="focal_region" id="ball"><string name="filename" value="../ball.ply"/>'
        '<transform name="to_world"><translate y="0.3"/></transform></shape>'
    )
    (other / "r.xml").write_text(f'<scene version="3.0.0">{region}</scene>')
    scene = load_edit_scene(path, regions=other / "r.xml")
    describe_run(scene, CONFIG, tmp_path / "run" / "out", "command")
    for name in ("regions/r.xml", "ball.ply", "animal.ply", "scene.xml"):
        (tmp_path / name).unlink()
    said: list[str] = []
    read, _ = saved_run(tmp_path / "run" / "out", say=said.append)
    assert len(said) == 1 and "gone; taking the copy of it" in said[0]
    assert read.regions[0].volume == scene.regions[0].volume and len(read.base[0].faces) == len(scene.base[0].faces)


def test_the_scene_as_it_was_is_read_and_said(make_scene: Make, tmp_path: Path) -> None:
    """One rule: the original if it is as it was, else the copy; and if that was changed as well, a refusal."""
    path, out = make_scene(), tmp_path / "runs" / "out"
    describe_run(load_edit_scene(path), CONFIG, out, "command")
    said: list[str] = []
    assert saved_run(out, say=said.append)[0].path.samefile(path) and said == []
    text, mesh = path.read_text(), (tmp_path / "animal.ply").read_bytes()
    copy = out / "scene" / "scene.xml"
    path.write_text(text.replace("wings", "horns"))
    scene, _ = saved_run(out, say=said.append)
    assert scene.prompt == "a pig with two wings" and scene.path.samefile(copy)
    assert "was changed since the run; taking the copy" in said.pop()
    assert saved_run(out, {}, said.append)[0].path.samefile(copy) and said.pop()
    path.write_text(text)
    (tmp_path / "animal.ply").unlink()
    assert saved_run(out, say=said.append)[0].path.samefile(copy) and "cannot be read any more" in said.pop()
    copy.write_text(text.replace("wings", "horns"))
    with pytest.raises(UserError, match="was changed, too"):
        saved_run(out, say=said.append)
    (tmp_path / "animal.ply").write_bytes(mesh)
    assert saved_run(out, say=said.append)[0].path.samefile(path) and said == []
    shutil.rmtree(out / "scene")
    path.unlink()
    with pytest.raises(UserError, match="has no copy of it; put it back"):
        saved_run(out, say=said.append)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("run.json", '{"scene": 3}'),
        ("run.json", '{"scene": "s.xml", "scene_hash": "0", "prompt": "p", "parameters": {"a": 1}}'),
        ("run.json", '{"scene": "s.xml", "scene_hash": "0", "prompt": "p", "parameters": [], "regions": 3}'),
        ("run.json", "[" * 100_000),
        ("run.json", '{"a": ' * 5000 + "1" + "}" * 5000),
        ("run.json", '{"scene": Infinity}'),
        ("config.json", '{"seed": "x"}'),
        ("config.json", '{"geometry": {"steps": 1e999}}'),
        ("config.json", '{"geometry": 3}'),
        ("scene/elsewhere/names.json", '{"animal.ply": "../../../../etc/passwd"}'),
        ("scene/elsewhere/names.json", '{"animal.ply": 3}'),
        ("scene/elsewhere/names.json", "[1]"),
    ],
)
def test_a_damaged_record_is_one_line(make_scene: Make, tmp_path: Path, name: str, text: str) -> None:
    path, out = make_scene(), tmp_path / "out"
    describe_run(load_edit_scene(path), CONFIG, out, "command")
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text(text)
    path.unlink()
    with pytest.raises(UserError) as caught:
        saved_run(out, say=lambda line: None)
    assert Path(name).name in str(caught.value) or "animal.ply" in str(caught.value)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
