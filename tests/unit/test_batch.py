"""Batches with a stand-in for `fd_mitsuba run`: the matrix of jobs, skipping, failures, killed runs, stops."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest

from fd_mitsuba.batch.local import Job, Outcome, is_finished, job_matrix, run_batch
from fd_mitsuba.batch.record import read_record
from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError

STUB = """
import json, os, shutil, signal, sys, time
from pathlib import Path
words = sys.argv[1:]
folder, scene = Path(words[words.index("-o") + 1]), Path(words[1])
seed = next(int(w[5:]) for w in words if w.startswith("seed="))
script = json.loads(Path(__file__).with_name("script.json").read_text()).get(folder.name, [])
tries = folder.with_name(folder.name + ".tries")
done = len(tries.read_text()) if tries.exists() else 0
tries.write_text("x" * (done + 1))
what = script[done] if done < len(script) else "finish"
assert ("--resume" in words) == (folder / "run.json").exists()
if what == "fail":
    print("fd_mitsuba: error: the part vanished; choose another seed", file=sys.stderr)
    sys.exit(1)
(folder / "scene").mkdir(parents=True, exist_ok=True)
shutil.copy(scene, folder / "scene" / scene.name)
(folder / "run.json").write_text(json.dumps({"scene": str(scene), "parameters": {}, "prompt": "a cat"}))
if what == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if what == "wait":
    def stop(number, frame):
        (folder / "saved").touch()
        sys.exit(130)
    signal.signal(signal.SIGTERM, stop)
    (folder / "waiting").touch()
    time.sleep(60)
shutil.copy(folder.with_name(folder.name + ".settings"), folder / "config.json")
(folder / "metrics.json").write_text(json.dumps({"seconds": 7.0, "stages": {"geometry": "done", "appearance": "done"}}))
"""


class Place:
    """Scenes, settings and a stand-in whose deeds are listed by run: finish, fail, die, wait."""

    def __init__(self, root: Path) -> None:
        self.root, self.out = root, root / "out"
        for name in ("cat", "mug"):
            (root / name).mkdir()
            (root / name / "scene.xml").write_text(f"<scene name='{name}'/>")
        (root / "quick.toml").write_text("seed = 5\n[geometry]\nsteps = 3\n")
        (root / "stub.py").write_text(STUB)
        self.script({})
        self.said: list[str] = []

    def script(self, deeds: dict[str, list[str]]) -> None:
        (self.root / "script.json").write_text(json.dumps(deeds))

    def jobs(self, seeds: tuple[int, ...] = (0, 1)) -> list[Job]:
        scenes = [self.root / "cat", self.root / "mug" / "scene.xml"]
        return job_matrix(scenes, [self.root / "quick.toml"], seeds, (), self.out)

    def run(self, jobs: list[Job], workers: int = 2, **more: object) -> list[Outcome]:
        program = (sys.executable, str(self.root / "stub.py"))
        record = self.out / "batch.json"
        self.out.mkdir(exist_ok=True)
        for job in jobs:  # the stand-in does not read settings itself
            job.folder.with_name(f"{job.name}.settings").write_text(job.settings().model_dump_json())
        return run_batch(jobs, workers, self.said.append, record=record, program=program, threads=1, **more)


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def states(outcomes: list[Outcome]) -> list[str]:
    return [outcome.state for outcome in outcomes]


def test_matrix(place: Place) -> None:
    names = [job.name for job in place.jobs()]
    assert names == ["cat-quick-0", "cat-quick-1", "mug-quick-0", "mug-quick-1"]
    (job,) = job_matrix([place.root / "cat"], [place.root / "quick.toml"], None, ("geometry.views=2",), place.out)
    assert job.name == "cat-quick-5" and job.settings() == RunConfig.load(job.config, ["geometry.views=2"])
    (default,) = job_matrix([place.root / "cat"], [], [3], (), place.out)
    assert default.name == "cat-default-3" and "-c" not in default.words(1)


@pytest.mark.parametrize(
    ("scenes", "overrides", "expected"),
    [(["dog"], (), "no such scene"), (["cat", "cat"], (), "two jobs"), (["cat"], ("geometry.step=3",), "unknown key")],
)
def test_bad_matrix(place: Place, scenes: list[str], overrides: tuple[str, ...], expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        job_matrix([place.root / name for name in scenes], [], [0], overrides, place.out)


def test_finished_runs_are_skipped(place: Place) -> None:
    jobs = place.jobs()
    assert states(place.run(jobs)) == ["finished"] * 4
    again = place.run(jobs)
    assert states(again) == ["skipped"] * 4 and again[0].seconds == 7.0
    assert (place.out / "cat-quick-0.tries").read_text() == "x"
    assert [row["state"] for row in read_record(place.out / "batch.json")] == ["skipped"] * 4


@pytest.mark.parametrize("change", ["settings", "scene", "stage", "parameters"])
def test_a_run_of_something_else_is_not_finished(place: Place, change: str) -> None:
    job = place.jobs()[0]
    place.run([job])
    assert is_finished(job)
    if change == "settings":
        (place.root / "quick.toml").write_text("[appearance]\nsteps = 4\n[geometry]\nsteps = 3\n")
    elif change == "scene":
        job.scene.write_text("<scene name='dog'/>")
    elif change == "parameters":
        job = Job(job.scene, job.config, job.seed, (), job.folder, definitions=("light=a.exr",))
    else:
        (job.folder / "metrics.json").write_text('{"stages": {"geometry": "done"}}')
        assert is_finished(Job(job.scene, job.config, job.seed, (), job.folder, stage="geometry"))
    assert not is_finished(job)


def test_a_failure_is_kept_and_reported(place: Place) -> None:
    place.script({"cat-quick-1": ["fail", "fail"]})
    outcomes = place.run(place.jobs(), retries=3)
    assert states(outcomes) == ["finished", "failed", "finished", "finished"]
    assert outcomes[1].message == "the part vanished; choose another seed" and outcomes[1].attempts == 1
    row = read_record(place.out / "batch.json")[1]
    assert row["state"] == "failed" and "vanished" in Path(row["log"]).read_text()


def test_a_killed_run_goes_on(place: Place) -> None:
    place.script({"cat-quick-0": ["die"], "mug-quick-0": ["die", "die"]})
    outcomes = place.run(place.jobs((0,)))
    assert states(outcomes) == ["finished", "failed"]
    assert [outcome.attempts for outcome in outcomes] == [2, 2]
    assert "SIGKILL" in outcomes[1].message and any("taken up again" in line for line in place.said)


def test_the_record_keeps_other_batches(place: Place) -> None:
    place.run(place.jobs((0,)))
    place.run(place.jobs((1,)))
    assert {row["name"] for row in read_record(place.out / "batch.json")} == {job.name for job in place.jobs()}


def test_one_writer_a_folder(place: Place) -> None:
    job = place.jobs()[0]
    place.out.mkdir(exist_ok=True)
    with open(job.log, "ab") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        worker = threading.Thread(target=place.run, args=([job],))
        worker.start()
        time.sleep(1)
        assert not job.folder.exists()
    worker.join(30)
    assert is_finished(job)


def test_a_stop_leaves_everything_resumable(place: Place) -> None:
    place.script({"cat-quick-0": ["wait"]})
    code = f"""
        import sys
        from pathlib import Path
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_batch import Place, states
        place = Place.__new__(Place)
        place.root, place.out, place.said = Path({str(place.root)!r}), Path({str(place.out)!r}), []
        print(states(place.run(place.jobs((0,)), workers=1)))
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True)
    until = time.monotonic() + 60
    while not (place.out / "cat-quick-0" / "waiting").exists() and time.monotonic() < until:
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    assert process.communicate(timeout=60)[0].strip() == "['interrupted', 'interrupted']"
    assert (place.out / "cat-quick-0" / "saved").exists()
    assert [row["state"] for row in read_record(place.out / "batch.json")] == ["interrupted"] * 2
    assert states(place.run(place.jobs((0,)))) == ["finished", "finished"]


def test_command_line(place: Place, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    place.script({"mug-quick-0": ["fail"]})
    program = (sys.executable, str(place.root / "stub.py"))
    monkeypatch.setitem(run_batch.__kwdefaults__, "program", program)
    place.out.mkdir()
    for job in place.jobs((0,)):
        job.folder.with_name(f"{job.name}.settings").write_text(job.settings().model_dump_json())
    words = ["batch", place.root / "cat", place.root / "mug", "-c", place.root / "quick.toml", "--seeds", "0"]
    words = [str(word) for word in (*words, "-o", place.out)]
    assert main(words) == 1
    out, error = capfd.readouterr()
    assert "vanished" in out and "mug-quick-0.log" in out and "[2/2]" in error
    assert "cat-quick-0" in (place.out / "gallery.html").read_text()
    assert main(words) == 0  # the stand-in fails once only
    assert main([*words, "--workers", "0"]) == 1
    assert "--workers 0" in capfd.readouterr().err
