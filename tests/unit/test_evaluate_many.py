"""Which scenes `evaluate --all` takes, in which order they run, and how several processes share the evaluations."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from fd_mitsuba.batch import local as batch
from fd_mitsuba.cli import evaluate as cli_evaluate
from fd_mitsuba.cli.main import main
from fd_mitsuba.evaluation.side_processes import evaluate_at_once

ROOT = Path(__file__).resolve().parents[2]
WRITES_ITS_WORDS = (
    "import pathlib, sys; words = sys.argv[1:]; pathlib.Path(words[1], 'words').write_text(' '.join(words)); "
    "sys.exit('bad' in words[1])"
)


def test_processes_share_the_runs(tmp_path: Path) -> None:
    runs = [tmp_path / name for name in ("a", "b", "c")]
    for run in runs:
        run.mkdir()
    program = (sys.executable, "-c", WRITES_ITS_WORDS)
    assert evaluate_at_once(runs, 2, ["--views", "7"], program)
    assert (runs[0] / "words").read_text().startswith(f"evaluate {runs[0]} {runs[2]} --views 7 -t ")
    assert (runs[1] / "words").read_text().startswith(f"evaluate {runs[1]} --views 7 -t ")
    assert not (runs[2] / "words").exists()
    bad = tmp_path / "bad"
    bad.mkdir()
    assert not evaluate_at_once([runs[0], bad], 2, (), program)


def test_a_stop_ends_the_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen] = []

    class Stopped(subprocess.Popen):
        def wait(self, timeout: float | None = None) -> int:
            started.append(self)
            if len(started) == 1:
                raise KeyboardInterrupt
            return super().wait(timeout)

    monkeypatch.setattr(subprocess, "Popen", Stopped)
    before = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        evaluate_at_once([tmp_path, tmp_path], 2, (), (sys.executable, "-c", "import time; time.sleep(60)"))
    assert time.monotonic() - before < 30 and all(process.returncode is not None for process in started)


def test_all_takes_the_scenes_that_the_model_can_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    taken: list[list[str]] = []

    def run_scenes(options: object, scenes: list[Path]) -> tuple[list[Path], int]:
        taken.append([scene.parent.name for scene in scenes])
        return [], 0

    monkeypatch.setattr(cli_evaluate, "run_scenes", run_scenes)
    words = ["evaluate", "--all", "--scenes", str(ROOT / "scenes"), "-c", str(ROOT / "configs" / "quick.toml")]
    assert main(words) == 0
    said = capsys.readouterr().err
    assert len(taken[0]) == 13 and "cup_straw: left out, since builtin does not know" in said and "'straw'" in said
    assert "stump_butterfly: left out" in said and said.count("left out") == 2
    assert main([*words, "--set", f"guidance.model={tmp_path}"]) == 0  # a folder whose words nobody has listed
    assert len(taken[1]) == 15 and "left out" not in capsys.readouterr().err


def test_every_scene_is_run_once_before_any_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []

    def run_batch(jobs: list, *_: object, **__: object) -> list:
        names.extend(job.name for job in jobs)
        return []

    monkeypatch.setattr(batch, "run_batch", run_batch)
    scenes = [str(ROOT / "scenes" / name / "scene.xml") for name in ("mug", "cat")]
    words = ["-c", str(ROOT / "configs" / "quick.toml"), "-o", str(tmp_path), "--scenes", str(ROOT / "scenes")]
    assert main(["evaluate", *scenes, *words, "--seeds", "4", "1"]) == 0
    assert names == ["mug-quick-4", "cat-quick-4", "mug-quick-1", "cat-quick-1"]
