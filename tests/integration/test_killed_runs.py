"""Runs of both stages that are killed, interrupted or started twice: the same bytes in the end, and one writer."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import BOTH_STAGES_OUTPUT, FIELD, ORANGE_PART, TEXTURE, run_words, start_words, write_place
from warm_runs import WarmRun, start_warm

SETTINGS = (
    FIELD
    + """
[geometry]
steps = 6
grid_resolution = 16
lambda_sds = 0.0
focal_samples = 256
views = 1
spp = 1
"""
    + TEXTURE
    + """
[appearance]
steps = 5
views = 2
spp = 2
picture_size = 16
lambda_sds = 0.0
style = true
style_samples = 32
boundary_reach = 0.1
"""
    + BOTH_STAGES_OUTPUT
)
SPEAKING_OF_TIME = {"seconds", "peak_memory_mb"}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    return write_place(tmp_path_factory.mktemp("killed"), animal, SETTINGS, part=ORANGE_PART)


def start(place: Path, output: str, *more: str) -> WarmRun:
    return start_warm(run_words(place, output, *more))


def finish(place: Path, output: str, *more: str) -> float:
    """Run to the end, imports among it; the seconds that it took."""
    started = time.monotonic()
    process = start_words(run_words(place, output, *more))
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return time.monotonic() - started


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a run, without what says when and how long."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        data, name = path.read_bytes(), str(path.relative_to(folder))
        if name in ("command.txt", "report.html"):
            continue
        if name == "metrics.jsonl":
            rows = [json.loads(line) for line in data.decode().splitlines()]
            data = json.dumps([{k: v for k, v in row.items() if k not in SPEAKING_OF_TIME} for row in rows]).encode()
        if name == "metrics.json":
            values = json.loads(data)
            data = json.dumps({k: v for k, v in values.items() if k not in SPEAKING_OF_TIME}).encode()
        found[name] = data
    return found


@pytest.fixture(scope="module")
def whole(place: Path) -> tuple[dict[str, bytes], float]:
    """The files of a run that nobody disturbed, and the seconds that it took."""
    seconds = finish(place, "whole")
    return contents(place / "whole"), seconds


def kill_until_done(place: Path, whole: tuple[dict[str, bytes], float], kills: int, seed: int) -> None:
    """Kill a run at random moments, anywhere between its start and its end, and resume it; then all files are equal.

    A run that got to its end between two kills is compared, and the next one starts anew.
    """
    expected, seconds = whole
    generator, done, number = random.Random(seed), 0, 0
    while done < kills:
        output, number = f"run{number}", number + 1
        more: tuple[str, ...] = ()
        while done < kills:
            process = start_words(run_words(place, output, *more))
            try:
                process.communicate(timeout=generator.uniform(0, 1.1 * seconds))
                assert process.returncode == 0
                break
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
                done += 1
            more = ("--resume",) if (place / output).exists() else ()
        finish(place, output, "--resume")
        found = contents(place / output)
        assert sorted(found) == sorted(expected), f"seed {seed}, run {number}"
        different = [name for name in expected if found[name] != expected[name]]
        assert not different, f"seed {seed}, run {number}: {different}"


def test_the_run_has_all_that_a_run_can_have(whole: tuple[dict[str, bytes], float]) -> None:
    names = set(whole[0])
    assert {"export/asset.glb", "export/textures/part_part_base_color.png", "images/appearance.png"} <= names
    assert {"checkpoints/step_000006.safetensors", "checkpoints_appearance/step_000005.safetensors"} <= names
    assert ".lock" not in names and not [name for name in names if name.endswith(".tmp")]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_killed_at_random_moments_of_both_stages(place: Path, whole: tuple[dict[str, bytes], float]) -> None:
    kill_until_done(place, whole, kills=2, seed=random.randrange(10**6))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_at_40_random_moments_of_both_stages(place: Path, whole: tuple[dict[str, bytes], float]) -> None:
    kill_until_done(place, whole, kills=40, seed=random.randrange(10**6))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("waited_for", ["images/channels.png", "export/part.json"])
def test_interrupted_while_it_bakes_or_exports(place: Path, waited_for: str) -> None:
    """After the last step nobody is in a loop that could save: the files that are there are whole, the rest is made."""
    output, more = f"baking_{Path(waited_for).stem}", ("--set", "output.texture_size=512")
    process = start(place, output, *more)
    deadline = time.monotonic() + 300
    while not (place / output / waited_for).exists():
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.5))
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    said = [line for line in errors.splitlines() if "interrupted" in line or "SIGINT" in line]
    assert process.returncode == 130 and len(said) == 1 and "--resume" in said[0], errors
    assert "Traceback" not in errors
    metrics = place / output / "metrics.json"
    assert not metrics.exists() or "stages" not in json.loads(metrics.read_text())
    resumed = start(place, output, "--resume", *more)
    assert resumed.communicate(timeout=600) and resumed.returncode == 0
    assert set(json.loads(metrics.read_text())["stages"].values()) == {"done"}
    assert (place / output / "export" / "asset.glb").is_file()


def twice_at_once(place: Path, output: str) -> None:
    """Two runs into one folder: one is refused in a line that names the other, which a kill then frees it from."""
    processes = [start(place, output, "--set", "geometry.steps=100000") for _ in range(2)]
    try:
        deadline = time.monotonic() + 300
        while all(process.poll() is None for process in processes):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        loser = next(process for process in processes if process.poll() is not None)
        winner = next(process for process in processes if process is not loser)
        _, errors = loser.communicate()
        assert loser.returncode == 1 and errors.count("\n") == 1, errors
        assert f"is used by process {winner.pid} on " in errors
        assert winner.poll() is None
    finally:
        for process in processes:
            if process.poll() is None:
                process.kill()
            process.communicate()
    assert (place / output / ".lock").exists()  # of a dead process
    more = ("--resume",) if (place / output / "run.json").exists() else ()
    third = start(place, output, "--set", "geometry.steps=100000", *more)
    try:
        deadline = time.monotonic() + 300
        while not (place / output / "checkpoints").exists():
            assert third.poll() is None and time.monotonic() < deadline, third.communicate()
            time.sleep(0.05)
    finally:
        third.kill()
        third.communicate()


@pytest.mark.timeout(600)
def test_two_runs_at_once_into_one_folder(place: Path) -> None:
    twice_at_once(place, "twice")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_two_runs_at_once_into_one_folder_20_times(place: Path) -> None:
    for number in range(20):
        twice_at_once(place, f"twice{number}")
