"""Whole runs through the command line: outputs, both Stable Diffusion layouts, interruption, resuming, killing."""

from __future__ import annotations

import contextlib
import json
import random
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import trimesh
from PIL import Image
from tiny_pipelines import save_pipeline
from tiny_runs import FIELD, run_words, start_words, write_place
from warm_runs import WarmRun, start_warm

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.final_surface.final_part import final_part
from fd_mitsuba.io.atomic import is_litter
from fd_mitsuba.runs.geometry_outcome import load_finished_stage
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.training.checkpoint import list_checkpoints
from fd_mitsuba.training.record import read_metrics

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = (
    FIELD
    + """
[geometry]
steps = 6
coarse_fraction = 0.5
grid_resolution = 16
focal_samples = 256
views = 2
spp = 1
[guidance]
guidance_scale = 7.0
[output]
sheet_every = 3
checkpoint_every = 4
turntable_frames = 3
turntable_size = 32
picture_size = 0
faces = 1000
"""
)
STEPS = 6
LONG = ("--set", "geometry.lambda_sds=0", "--set", "geometry.steps=100000", "--set", "output.checkpoint_every=7")
"""A run without guidance: its steps take milliseconds, and writing is a good part of them, so kills hit the writes."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    """A folder with a scene, settings, and pipelines shaped like SD 1.5 and SD 2.1."""
    root = write_place(tmp_path_factory.mktemp("place"), animal, SETTINGS)
    for kind in ("sd15", "sd21"):
        save_pipeline(kind, root / kind)
    return root


def arguments(place: Path, output: str, *more: str) -> list[str]:
    model = f"guidance.model={place / 'sd15'}"
    return run_words(place, output, "--set", model, "--stage", "geometry", *more)


@contextlib.contextmanager
def started(place: Path, output: str, *more: str, cold: bool = False) -> Iterator[subprocess.Popen[str] | WarmRun]:
    """A run that ends with the block; `cold`: imports are a part of it."""
    start = start_words if cold else start_warm
    process = start(arguments(place, output, *more), HF_HUB_OFFLINE="1", XDG_CACHE_HOME=str(place / "cache"))
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate(timeout=60)


def finish(place: Path, output: str, *more: str, cold: bool = False) -> str:
    """Run to the end and return what it said on stderr."""
    with started(place, output, *more, cold=cold) as process:
        _, errors = process.communicate(timeout=120)
        assert process.returncode == 0, errors
    return errors


def rows(folder: Path) -> list[int]:
    return [row["step"] for row in read_metrics(folder / "metrics.jsonl")]


def wait_for(process: subprocess.Popen[str] | WarmRun, condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + 90
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "the run did not get there"
        time.sleep(0.002)


def last_bytes(folder: Path, step: int) -> bytes:
    newest = list_checkpoints(folder / "checkpoints")[-1]
    assert newest.stem == f"step_{step:06d}"
    return newest.read_bytes()


@pytest.fixture(scope="module")
def finished(place: Path) -> Path:
    """The run folder of a whole run with the SD-1.5-shaped pipeline, one thread."""
    finish(place, "whole", cold=True)
    return place / "whole"


def test_every_output_opens(finished: Path, place: Path) -> None:
    part = trimesh.load(finished / "export" / "part_part.ply")
    whole = trimesh.load(finished / "export" / "assembled.ply")
    assert part.is_watertight and whole.is_watertight and part.volume > 0 and whole.volume > part.volume
    # In the user's frame: the part is where the scene has its region.
    assert np.allclose(part.bounds.mean(axis=0), [0, 0.35, 0], atol=0.1)
    assert (finished / "export" / "base" / "animal.ply").read_bytes() == (place / "animal.ply").read_bytes()
    frames = imageio.imread(finished / "videos" / "turntable.mp4", plugin="pyav")
    assert frames.shape == (3, 32, 32, 3) and frames[0].std() > 10
    names = ("turntable.png", "step_000003.png", "step_000006.png")
    for name in names:
        with Image.open(finished / "images" / name) as picture:
            assert np.asarray(picture).std() > 5


def test_metrics_of_the_run(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["base_identical"] is True and metrics["steps"] == STEPS and metrics["seconds"] > 0
    assert 0.9 <= metrics["inside_fraction"] <= 1 and 0 <= metrics["overlap_fraction"] < 0.5
    assert metrics["part_faces"]["part"] > 20 and metrics["prompt"] == "a pig with two wings"


def test_overlap_is_that_of_the_part_as_it_grew(finished: Path, place: Path) -> None:
    """The exported solid reaches into the base on purpose, so it overlaps more."""
    config = RunConfig.load(place / "tiny.toml", [f"guidance.model={place / 'sd15'}"])
    scene = load_edit_scene(place / "scene.xml")
    stage = load_finished_stage(scene, config, finished)
    vertices, faces = (tensor.numpy() for tensor in stage.extractor.extract_part(stage.field))
    exported = trimesh.load(finished / "export" / "part_part.ply")
    base = trimesh.load(finished / "export" / "base" / "animal.ply")

    def overlap(part_vertices: np.ndarray, part_faces: np.ndarray) -> float:
        low, high = part_vertices.min(axis=0), part_vertices.max(axis=0)
        points = np.random.default_rng(0).uniform(low, high, (40000, 3))
        points = points[MeshDistance(part_vertices, part_faces).inside(points)]
        return float(MeshDistance(base.vertices, base.faces).inside(points).mean())

    metrics = json.loads((finished / "metrics.json").read_text())
    grown = overlap(scene.frame.to_user(vertices), faces)
    assert metrics["overlap_fraction"] == pytest.approx(grown, abs=0.02)
    assert overlap(exported.vertices, exported.faces) > grown


def test_rows_of_both_phases(finished: Path) -> None:
    data = read_metrics(finished / "metrics.jsonl")
    assert [row["step"] for row in data] == list(range(1, STEPS + 1))
    assert [row["phase"] for row in data] == ["coarse"] * 3 + ["refined"] * 3
    wanted = {"loss", "loss_sds", "loss_focal", "loss_collision", "part_faces"}
    assert all(wanted <= set(row) and all(np.isfinite(row[name]) for name in wanted) for row in data)
    assert "volume_ratio" in data[-1] and "loss_volume" not in data[0]


def test_record_of_what_was_run(finished: Path, place: Path) -> None:
    assert (finished / "command.txt").read_text().startswith("fd_mitsuba run ")
    config = RunConfig.load(place / "tiny.toml", [f"guidance.model={place / 'sd15'}"])
    assert config.model_dump(mode="json") == json.loads((finished / "config.json").read_text())
    environment = json.loads((finished / "environment.json").read_text())
    assert environment["mitsuba"].startswith("3.9") and environment["threads"] == 1
    assert (finished / "scene" / "scene.xml").read_bytes() == (place / "scene.xml").read_bytes()
    load_edit_scene(finished / "scene" / "scene.xml")  # the copy can be edited again
    assert not [path for path in finished.rglob(".*") if is_litter(path)]


def test_finished_stage_can_be_loaded(finished: Path, place: Path) -> None:
    scene = load_edit_scene(place / "scene.xml")
    config = RunConfig.load(place / "tiny.toml", [f"guidance.model={place / 'sd15'}"])
    stage = load_finished_stage(scene, config, finished)
    metrics = json.loads((finished / "metrics.json").read_text())
    assert len(final_part(stage.grown(), "part", config.output.faces).solid.faces) == metrics["part_faces"]["part"]


def test_interrupted_and_resumed_gives_the_same_bytes(finished: Path, place: Path) -> None:
    stop_after = random.randint(1, STEPS - 2)
    with started(place, "stopped") as process:
        wait_for(process, lambda: len(rows(place / "stopped")) >= stop_after)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert errors.count("\n") == 1 and "SIGINT: stopped after step" in errors and "--resume" in errors
    done = rows(place / "stopped")[-1]
    assert last_bytes(place / "stopped", done)
    assert f"resuming after step {done} of {STEPS}" in finish(place, "stopped", "--resume")
    assert rows(place / "stopped") == list(range(1, STEPS + 1))
    assert last_bytes(place / "stopped", STEPS) == last_bytes(finished, STEPS), f"stopped after step {done}"
    for name in ("part_part.ply", "assembled.ply"):
        assert (place / "stopped" / "export" / name).read_bytes() == (finished / "export" / name).read_bytes()
    assert (place / "stopped" / "command.txt").read_text().count("\n") == 2


def kill_and_resume(place: Path, output: str, kills: int, seed: int) -> None:
    """Kill a run at random moments from its very start on; each resume loses no more than since the last checkpoint."""
    folder, generator = place / output, random.Random(seed)
    for attempt in range(kills):
        resume = ("--resume",) if attempt else ()
        anywhere = attempt % 4 == 3
        with started(place, output, *resume, *LONG, cold=anywhere) as process:
            if anywhere:
                time.sleep(generator.uniform(0, 8))  # in the imports, the first writes, the loop
            else:
                before = rows(folder)
                wait_for(process, lambda before=before: rows(folder) != before)
                time.sleep(generator.uniform(0, 0.3))
            process.kill()
            process.communicate(timeout=60)
        reached = (rows(folder)[-1:] or [0])[0]
        checkpoints = list_checkpoints(folder / "checkpoints") if folder.exists() else []
        saved = int(checkpoints[-1].stem[5:]) if checkpoints else 0
        assert reached - saved <= 7, "a checkpoint is missing"
        assert process.returncode == -signal.SIGKILL
    with started(place, output, "--resume", *LONG) as process:
        before = rows(folder)
        wait_for(process, lambda: rows(folder) != before)  # the file is renewed once signals are listened to
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "SIGTERM" in errors
    said = f"resuming after step {saved} of" if saved else "no checkpoint yet"
    assert said in errors and "damaged" not in errors
    assert rows(folder) == list(range(1, rows(folder)[-1] + 1))
    assert not [path for path in folder.rglob(".*") if is_litter(path)]


def test_killed_at_random_moments(place: Path) -> None:
    kill_and_resume(place, "killed", kills=3, seed=random.randrange(10**6))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_killed_at_many_random_moments(place: Path) -> None:
    kill_and_resume(place, "killed_often", kills=20, seed=random.randrange(10**6))


def test_second_signal_ends_at_once_and_can_be_resumed(place: Path) -> None:
    with started(place, "twice", *LONG) as process:
        wait_for(process, lambda: len(rows(place / "twice")) >= 10)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode in (130, -signal.SIGINT) and "Traceback" not in errors
    assert list_checkpoints(place / "twice" / "checkpoints")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_before_the_first_step(place: Path, number: signal.Signals) -> None:
    output = f"early_{number.name}"
    with started(place, output, cold=True) as process:
        time.sleep(random.uniform(0.6, 2.5))  # among the imports
        assert not (place / output / "metrics.jsonl").exists()
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "fd_mitsuba: interrupted; continue with --resume\n")


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signal_during_the_export(place: Path, number: signal.Signals) -> None:
    output = f"export_{number.name}"
    more = (*LONG[:2], "--set", "output.turntable_frames=150")
    with started(place, output, *more) as process:
        wait_for(process, lambda: (place / output / "export" / "assembled.ply").exists())
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "fd_mitsuba: interrupted; continue with --resume\n")
    assert not (place / output / "metrics.json").exists()
    finish(place, output, "--resume", *more)
    assert (place / output / "metrics.json").exists()


# From here on within this process: Mitsuba is there already, so that a run takes a second.


def run_here(place: Path, output: str, *more: str) -> int:
    line = arguments(place, output, *more)
    del line[line.index("-t") : line.index("-t") + 2]  # the other tests keep their threads
    return main(line)


def one_error(captured: pytest.CaptureFixture[str]) -> str:
    errors = captured.readouterr().err
    assert errors.count("\n") == 1 and errors.startswith("fd_mitsuba: error: "), errors
    return errors


def test_three_steps_of_both_phases_shaped_like_sd21(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_network(*_: object) -> None:
        raise AssertionError("somebody asked the network")

    monkeypatch.setattr(socket.socket, "connect", no_network)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert run_here(place, "run21", "--set", f"guidance.model={place / 'sd21'}") == 0
    data = read_metrics(place / "run21" / "metrics.jsonl")
    assert [row["phase"] for row in data] == ["coarse"] * 3 + ["refined"] * 3
    assert all(np.isfinite(row["loss_sds"]) and row["loss_sds"] > 0 for row in data)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--prompt", "a pig with a hat"), "other prompt ('a pig with two wings', now 'a pig with a hat')"),
        (("--set", "geometry.steps=9"), "geometry.steps = 6, now 9"),
        (("--set", "seed=3"), "seed = 0, now 3"),
    ],
)
def test_resume_with_other_input_is_refused(
    finished: Path, place: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], words: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    assert run_here(place, "whole", "--resume", *more) == 1
    assert words in one_error(capsys)
    assert before == {path: path.stat().st_mtime_ns for path in finished.rglob("*")}


def test_resume_after_the_scene_changed_is_refused(
    finished: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (place / "scene.xml").read_text()
    try:
        (place / "scene.xml").write_text(text.replace('x="0.12"', 'x="0.13"'))
        assert run_here(place, "whole", "--resume") == 1
    finally:
        (place / "scene.xml").write_text(text)
    assert "another scene, or a file of the scene was changed" in one_error(capsys)


def test_run_into_a_folder_that_is_taken(finished: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_here(place, "whole") == 1
    assert "holds a run already; add --resume" in one_error(capsys)
    (place / "photos").mkdir()
    (place / "photos" / "a.jpg").write_text("x")
    for more in ((), ("--resume",)):
        assert run_here(place, "photos", *more) == 1
        assert "not empty and not a run" in one_error(capsys)
    assert [path.name for path in (place / "photos").iterdir()] == ["a.jpg"]


def test_resume_of_a_finished_run_exports_again(
    finished: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(finished, place / "again")
    (copy / "export" / "assembled.ply").unlink()
    (copy / "metrics.json").unlink()
    assert run_here(place, "again", "--resume") == 0
    assert (copy / "metrics.json").exists() and (copy / "export" / "assembled.ply").exists()
    assert last_bytes(copy, STEPS) == last_bytes(finished, STEPS)


def test_weight_zero_turns_the_work_off(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("work for a loss that does not count")

    for name in ("loss_focal", "loss_collision", "DiffusionGuidance.load"):
        module = "fd_mitsuba.guidance.sources" if "." in name else "fd_mitsuba.training.geometry_losses"
        monkeypatch.setattr(f"{module}.{name}", never)
    weights = ("lambda_sds=0", "lambda_focal=0", "lambda_collision=0", "lambda_volume=0.1")
    assert run_here(place, "off", *[word for weight in weights for word in ("--set", f"geometry.{weight}")]) == 0
    data = read_metrics(place / "off" / "metrics.jsonl")
    assert len(data) == STEPS and all(
        {name for name in row if name.startswith("loss_")} == {"loss_volume"} for row in data
    )


def test_all_weights_zero_runs_and_changes_nothing(place: Path) -> None:
    weights = ("lambda_sds=0", "lambda_focal=0", "lambda_collision=0")
    assert run_here(place, "idle", *[word for weight in weights for word in ("--set", f"geometry.{weight}")]) == 0
    data = read_metrics(place / "idle" / "metrics.jsonl")
    assert all(row["loss"] == 0 for row in data) and data[-1]["volume_ratio"] == pytest.approx(1, abs=0.01)


def test_part_that_vanishes_stops_the_run_and_keeps_the_checkpoint(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ["geometry.lambda_sds=0", "geometry.lambda_focal=0", "geometry.lambda_collision=0"]
    more += ["geometry.lambda_volume=10", "geometry.learning_rate=0.01", "geometry.steps=200"]
    assert run_here(place, "gone", *[word for item in more for word in ("--set", item)]) == 1
    error = one_error(capsys)
    step = int(list_checkpoints(place / "gone" / "checkpoints")[-1].stem[5:])
    assert "vanished" in error and f"gone keeps the state after step {step}: try other settings" in error
    assert not (place / "gone" / "export").exists()


def test_part_that_vanishes_at_once_leaves_no_folder(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["geometry.lambda_sds=0", "geometry.lambda_focal=0", "geometry.lambda_collision=0"]
    more += ["geometry.lambda_volume=10", "geometry.learning_rate=0.03", "output.checkpoint_every=500"]
    words = [word for item in [*more, "geometry.steps=200"] for word in ("--set", item)]
    for _ in range(2):  # the same command can be repeated
        assert run_here(place, "nothing", *words) == 1
        assert "no step was kept, so the same -o can be used again" in one_error(capsys)
        assert not (place / "nothing").exists()


def test_mitsuba_itself_opens_the_scene_after_register(place: Path) -> None:
    import fd_mitsuba

    scene = fd_mitsuba.register().load_file(str(place / "scene.xml"))
    assert scene.integrator().prompt == "a pig with two wings" and len(scene.shapes()) == 2
