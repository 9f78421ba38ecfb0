"""Tiny real runs as a batch on Ray, two at a time; one run is killed, or the worker above it. Slow, and needs Ray."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import BASE, INTEGRATOR, PART, REGION, write_ply
from test_whole_run import LIGHT, SETTINGS
from tiny_pipelines import save_pipeline

from fd_mitsuba.batch.local import is_finished, job_matrix
from fd_mitsuba.training.record import read_metrics

pytest.importorskip("ray")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    root = tmp_path_factory.mktemp("batch")
    for name in ("pig", "hog"):
        (root / name).mkdir()
        write_ply(root / name / "animal.ply", *animal)
        pieces = ['<scene version="3.0.0">', LIGHT, INTEGRATOR, BASE, PART, REGION, "</scene>"]
        (root / name / "scene.xml").write_text("\n".join(pieces))
    (root / "tiny.toml").write_text(SETTINGS.replace("steps = 2", "steps = 12", 1))
    save_pipeline("sd15", root / "sd15")
    return root


def start(place: Path, output: str) -> subprocess.Popen:
    words = ["batch", place / "pig", place / "hog", "-c", place / "tiny.toml", "--seeds", 0, 1, 2, "-t", 1]
    words += ["--set", f"guidance.model={place / 'sd15'}", "-o", place / output, "--workers", 2, "--ray"]
    command = [sys.executable, "-m", "fd_mitsuba", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def jobs(place: Path, output: str) -> list:
    scenes, overrides = [place / "pig", place / "hog"], (f"guidance.model={place / 'sd15'}",)
    return job_matrix(scenes, [place / "tiny.toml"], [0, 1, 2], overrides, place / output)


def process_of(folder: Path, batch: subprocess.Popen) -> tuple[int, int]:
    """Process ids of the run in the folder and of its parent, once it has done some steps."""
    until = time.monotonic() + 300
    while time.monotonic() < until and batch.poll() is None:
        if len(read_metrics(folder / "metrics.jsonl")) >= 3:
            for entry in Path("/proc").glob("[0-9]*"):
                words = (entry / "cmdline").read_bytes().split(b"\0") if (entry / "cmdline").exists() else []
                if b"run" in words and str(folder).encode() in words:
                    return int(entry.name), int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        time.sleep(0.02)
    batch.kill()
    raise AssertionError(f"the run has not begun: {batch.communicate()[0]}")


@pytest.mark.parametrize("victim", ["run", "worker"])
def test_one_of_six_is_killed(place: Path, victim: str) -> None:
    batch = start(place, victim)
    folder = place / victim / "pig-tiny-0"
    run, worker = process_of(folder, batch)
    os.kill(run if victim == "run" else worker, signal.SIGKILL)
    said = batch.communicate(timeout=1200)[0]
    assert batch.returncode == 0, said
    rows = json.loads((place / victim / "batch.json").read_text())["jobs"]
    assert [row["state"] for row in rows] == ["finished"] * 6 and all(map(is_finished, jobs(place, victim)))
    for job in jobs(place, victim):
        steps = [row["step"] for row in read_metrics(job.folder / "metrics.jsonl") if row["stage"] == "geometry"]
        assert steps == list(range(1, 13))
        assert (job.folder / "export" / "asset.glb").is_file()
    if victim == "run":
        assert rows[0]["attempts"] == 2


def test_a_stop_leaves_everything_resumable(place: Path) -> None:
    batch = start(place, "stopped")
    process_of(place / "stopped" / "pig-tiny-0", batch)
    batch.send_signal(signal.SIGINT)
    said = batch.communicate(timeout=300)[0]
    assert batch.returncode == 130, said
    rows = json.loads((place / "stopped" / "batch.json").read_text())["jobs"]
    assert {row["state"] for row in rows} <= {"interrupted", "finished"} and rows[-1]["state"] == "interrupted"
    # No process of the batch is left behind.
    words = b"".join(p.read_bytes() for p in Path("/proc").glob("[0-9]*/cmdline") if p.exists())
    assert str(place / "stopped").encode() not in words
