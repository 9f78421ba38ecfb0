"""Run folders: which may be used, what marks a run as another one, what is written down."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import Interrupted, RunStopped, UserError
from fd_mitsuba.runs.run_folder import check_folder, describe_run, discarded_without_checkpoint
from fd_mitsuba.scene.edit_scene import EditScene, load_edit_scene

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


@pytest.mark.parametrize("error", [UserError("no"), RunStopped("no"), OSError(28, "no space")])
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


def test_files_of_the_same_name_are_all_kept(tmp_path: Path, make_scene: Make) -> None:
    path = make_scene()
    place = tmp_path / "deep" / "scene"
    (place / "meshes").mkdir(parents=True)
    outside = tmp_path / "animal.ply"
    (place / "meshes" / "animal.ply").write_bytes(outside.read_bytes())
    text = path.read_text().replace('value="animal.ply"', 'value="meshes/animal.ply"')
    second = '<shape type="ply" id="two"><string name="filename" value="../../animal.ply"/></shape></scene>'
    (place / "scene.xml").write_text(text.replace("</scene>", second))
    describe_run(load_edit_scene(place / "scene.xml"), CONFIG, tmp_path / "out", "command")
    copies = tmp_path / "out" / "scene"
    assert (copies / "scene.xml").exists() and (copies / "meshes" / "animal.ply").exists()
    below = Path(*outside.resolve().parts[1:])
    assert (copies / "elsewhere" / below).read_bytes() == outside.read_bytes()
