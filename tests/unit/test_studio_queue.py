"""Runs of the studio: what they tell through files, one at a time, stopped, gone on with, found again."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.job import EventReader, EventWriter, RunOrder
from fd_mitsuba.studio.queue import RunQueue
from fd_mitsuba.studio.run_state import FAILED, FINISHED, QUEUED, RUNNING, STOPPED, RunState

PROGRAM = """
import json, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
order = json.loads((folder / "live/job.json").read_text())
stopped = []
signal.signal(signal.SIGINT, lambda *_: stopped.append(1))
signal.signal(signal.SIGTERM, lambda *_: stopped.append(1))
def tell(**row):
    with open(folder / "live/events.jsonl", "a") as file:
        file.write(json.dumps(row) + "\\n")
tell(event="begun")
if order["prompt"] == "bad":
    tell(event="failed", line="no such thing")
    sys.exit(1)
if order["prompt"] == "crash":
    sys.exit(3)
first = 3 if order["resume"] else 1
for step in range(first, 7):
    tell(event="step", stage="geometry", phase="coarse", step=step, total=6, losses={"loss_sds": 1 / step})
    while order["prompt"] == "slow" and step == 2 and not stopped:
        time.sleep(0.01)
    if stopped:
        tell(event="stopped", line="stopped after a step")
        sys.exit(130)
(folder / "metrics.json").write_text('{"stages": {}}')
tell(event="finished")
"""


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[RunQueue]:
    made = RunQueue(tmp_path / "runs", program=(sys.executable, "-I", "-c", PROGRAM))
    yield made
    made.close()


def order(prompt: str, seed: int = 0) -> RunOrder:
    return RunOrder("../../scene.xml", prompt, {"seed": seed})


def until(queue: RunQueue, condition: Callable[[], bool]) -> None:
    for _ in range(1500):
        queue.step()
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError({name: (run.state, run.line) for name, run in queue.runs.items()})


def test_one_at_a_time_in_order(queue: RunQueue, tmp_path: Path) -> None:
    one, two = (queue.add(tmp_path / "runs" / name, order("slow" if name == "a" else "x")) for name in "ab")
    runs = queue.runs
    until(queue, lambda: runs[one].step == 2)
    assert runs[one].state == RUNNING and runs[two].state == QUEUED and queue.waiting == ["b"]
    assert queue.current is runs[one] and "step 2 of 6" in runs[one].sentence()
    queue.stop(one)
    until(queue, lambda: runs[two].state == FINISHED)
    assert runs[one].state == STOPPED and runs[one].line == "stopped after a step"
    assert [step for _, step, _ in runs[two].history] == [1, 2, 3, 4, 5, 6]


def test_stopped_run_goes_on_even_for_another_server(queue: RunQueue, tmp_path: Path) -> None:
    name = queue.add(tmp_path / "runs" / "a", order("slow", seed=5))
    until(queue, lambda: queue.runs[name].step == 2)
    with pytest.raises(UserError, match="is running; only a run that stopped"):
        queue.resume(name)
    queue.stop(name)
    until(queue, lambda: queue.runs[name].state == STOPPED)
    other = RunQueue(tmp_path / "runs", program=(sys.executable, "-I", "-c", PROGRAM))
    found = other.runs[name]
    assert (found.state, found.step, found.total, found.seed, found.prompt) == (STOPPED, 2, 6, 5, "slow")
    other.resume(name)
    until(other, lambda: found.state == FINISHED)
    assert [step for _, step, _ in found.history] == [1, 2, 3, 4, 5, 6]
    assert RunQueue(tmp_path / "runs").runs[name].state == FINISHED


def test_close_lets_a_run_save(queue: RunQueue, tmp_path: Path) -> None:
    queue.add(tmp_path / "runs" / "a", order("slow"))
    queue.start()
    until_told = EventReader(tmp_path / "runs" / "a")
    for _ in range(1000):
        if any(row.get("step") == 2 for row in until_told.new()):
            break
        time.sleep(0.01)
    queue.close()
    lines = (tmp_path / "runs" / "a" / "live" / "events.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["event"] == "stopped"


def test_failures_say_why(queue: RunQueue, tmp_path: Path) -> None:
    for name in ("bad", "crash"):
        queue.add(tmp_path / "runs" / name, order(name))
    until(queue, lambda: queue.runs["crash"].state == FAILED)
    assert queue.runs["bad"].state == FAILED and queue.runs["bad"].line == "no such thing"
    assert "exit code 3" in queue.runs["crash"].line
    assert RunQueue(tmp_path / "runs").runs["bad"].state == FAILED


def test_waiting_run_can_be_taken_back(queue: RunQueue, tmp_path: Path) -> None:
    queue.add(tmp_path / "runs" / "a", order("x"))
    queue.stop("a")
    queue.step()
    assert queue.runs["a"].state == STOPPED and queue.current is None


def test_killed_process_counts_as_stopped(queue: RunQueue, tmp_path: Path) -> None:
    name = queue.add(tmp_path / "runs" / "a", order("slow"))
    until(queue, lambda: queue.runs[name].step == 2)
    assert queue._process is not None
    queue._process.kill()
    until(queue, lambda: queue.runs[name].state != RUNNING)
    assert queue.runs[name].state == STOPPED


def test_torn_lines_cost_nothing_else(tmp_path: Path) -> None:
    writer = EventWriter(tmp_path)
    writer.write("begun")
    reader = EventReader(tmp_path)
    assert [row["event"] for row in reader.new()] == ["begun"]
    with open(writer.path, "a") as file:
        file.write('{"event": "st')
    assert list(reader.new()) == []
    EventWriter(tmp_path).write("step", step=3, total=4, stage="geometry", losses={})
    assert [row["step"] for row in reader.new()] == [3]
    state = RunState(tmp_path)
    assert state.follow() and state.step == 3 and not state.follow()


@pytest.mark.parametrize("text", ["", "[]", "{", '{"scene": 3, "prompt": "x", "config": {}}', '{"other": 1}'])
def test_damaged_order_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "live").mkdir()
    (tmp_path / "live" / "job.json").write_text(text)
    with pytest.raises(UserError, match="job.json: is missing or damaged; grow the part anew"):
        RunOrder.read(tmp_path)
