"""The studio in a browser: a gizmo is dragged, a prompt typed, a part grows; the server is killed, and it goes on.

Slow, and skipped where there is no browser: it needs chromium, `npm install` in tools/viewers, and viser.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from viewer_setup import VIEWERS, glb_faults, needs_browser

from fd_mitsuba.io.glb import glb_content

sys.path.append(str(VIEWERS.parent))
from studio_process import upward_drag  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800), needs_browser]
WIDTH, HEIGHT = 1280, 860
STEPS = 120


class Served:
    """`fd_mitsuba studio` as a process, with its address."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "fd_mitsuba", "studio", *arguments, "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        found = re.search(r"http://\S+(?=,)", line)
        assert found, line + self.process.stdout.read()
        self.url = found[0]

    def end(self, number: int) -> int:
        self.process.send_signal(number)
        with self.process:  # closes the pipe
            return self.process.wait(120)


def driven(action: str, url: str, folder: Path, **options: Any) -> dict[str, Any]:
    script = str(VIEWERS / "studio_page.mjs")
    sized = {"width": WIDTH, "height": HEIGHT, **options}
    done = subprocess.run(["node", script, action, url, str(folder), json.dumps(sized)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert found["problems"] == [] and found["foreign"] == []
    return found


def until(condition: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.2)


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(float)


def test_grow_kill_resume_download(make_scene: Callable[..., Path], tmp_path: Path) -> None:
    scene, work = make_scene(), tmp_path / "work"
    slow = "geometry.learning_rate=1e-6"  # so many steps of these settings would leave nothing of the part
    slow_too = "appearance.steps=40"
    settings = ["--set", slow, "--set", slow_too, "-t", "1"]
    served = Served(str(scene), "-o", str(work), "-c", "smoke", *settings)
    try:
        record = json.loads((work / "studio.json").read_text())
        start = np.array(record["regions"][0]["centre"])
        from fd_mitsuba.scene.load_scene import load_edit_scene

        frame = load_edit_scene(scene).frame
        ends = upward_drag(frame.to_canonical(start), 0.1, WIDTH, HEIGHT)
        seen = driven(
            "grow", served.url, tmp_path, drag=ends, prompt="a pig with a pointed hat", told="with a pointed hat",
            steps=STEPS, tabs=2,
        )  # fmt: skip
        run = work / "runs" / "001"
        assert seen["prompt_of_other_tab"] == "a pig with a pointed hat"
        assert str(tmp_path) not in seen["text"] and "finished" not in seen["text"]
        moved = np.array(json.loads((work / "studio.json").read_text())["regions"][0]["centre"]) - start
        assert moved[1] * frame.scale == pytest.approx(0.1, abs=0.05) and abs(moved[[0, 2]]).max() < 1e-6
        opened, growing = pixels(tmp_path / "opened.png"), pixels(tmp_path / "growing.png")
        assert opened[:, : WIDTH // 2].std() > 10
        changed = np.abs(growing - opened)[:, : WIDTH // 2].max(axis=-1) > 25
        assert changed.mean() > 0.003 and not (run / "metrics.json").exists()
    finally:
        served.end(signal.SIGKILL)
    events = run / "live" / "events.jsonl"
    until(lambda: json.loads(events.read_text().splitlines()[-1])["event"] in ("stopped", "finished"))
    assert not (run / "metrics.json").exists(), "the run was over before the server was killed: take more steps"
    again = Served(str(run))
    try:
        seen = driven("resume", again.url, tmp_path, learning=10)
        assert re.search(rf"stopped: geometry, step \d+ of {STEPS}", seen["before"])
    finally:
        assert again.end(signal.SIGINT) == 0
    assert "resuming after step" in events.read_text()
    names = {node.get("name") for node in glb_content((tmp_path / seen["download"]).read_bytes())["nodes"]}
    assert {"base", "part_part"} <= names and glb_faults(tmp_path / seen["download"]) == {}
