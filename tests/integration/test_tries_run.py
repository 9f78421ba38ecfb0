"""`run --tries` from the command line, with the built-in prior and hardly any steps."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fd_mitsuba.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
PROMPT = '<integrator type="dual_path"><string name="prompt" value="a pig with two wings"/></integrator>'


def read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def test_two_seeds_one_run(make_scene: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    words = ["run", str(make_scene(integrator=PROMPT)), "-c", str(ROOT / "configs" / "smoke.toml"), "-t", "1", "-q"]
    words += ["--stage", "geometry", "-o", str(folder), "--set", "geometry.start_variety=0.6"]
    assert main([*words, "--tries", "2"]) == 0
    record, metrics = read(folder / "tries.json"), read(folder / "metrics.json")
    assert [one["seed"] for one in record["tries"]] == [0, 1] and record["taken"] in (0, 1)
    best = folder / "tries" / f"seed_{record['taken']}"
    scores = [read(folder / "tries" / f"seed_{seed}" / "metrics.json")["verdict"]["score"] for seed in (0, 1)]
    assert scores[record["taken"]] == max(scores) == metrics["verdict"]["score"]
    parts = [(folder / "tries" / f"seed_{seed}" / "export" / "part_part.ply").read_bytes() for seed in (0, 1)]
    assert parts[0] != parts[1] and (folder / "export" / "part_part.ply").read_bytes() == parts[record["taken"]]
    assert metrics["tries"].keys() == {"seed 0", "seed 1"} and (best / "report.html").is_file()
    assert "Seeds that were tried" in (folder / "report.html").read_text(encoding="utf-8")
    assert [row["stage"] for row in map(json.loads, (folder / "metrics.jsonl").open())] == ["geometry"] * 4
    heard = capsys.readouterr().err
    assert "try 2 of 2: seed 1" in heard and metrics["verdict"]["line"] in heard
    # Without --resume nothing is touched; with it no seed is run again.
    stamps = {path: path.stat().st_mtime_ns for path in (folder / "tries").rglob("*.ply")}
    assert main([*words, "--tries", "2"]) == 1 and "--resume" in capsys.readouterr().err
    assert main([*words, "--tries", "2", "--resume"]) == 0
    assert {path: path.stat().st_mtime_ns for path in (folder / "tries").rglob("*.ply")} == stamps
    assert main([*words, "--tries", "0", "--resume"]) == 1 and "give 1 or more" in capsys.readouterr().err
