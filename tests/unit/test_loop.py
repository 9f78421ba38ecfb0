"""The loop around a stage that does almost nothing: signals at awkward moments, checkpoints, failures."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
import torch

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import Interrupted, RunStopped
from fd_mitsuba.training.checkpoint import list_checkpoints
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.record import read_metrics
from fd_mitsuba.training.stage import StepRecord


class CountingStage:
    """Counts its steps in one weight; `at` maps (where, step) to what happens there."""

    def __init__(self, steps: int = 6, every: int = 3, at: dict[tuple[str, int], Any] | None = None) -> None:
        settings = {"geometry": {"steps": steps}, "output": {"checkpoint_every": every, "sheet_every": 0}}
        self.config = RunConfig.model_validate(settings)
        self.field = torch.nn.Linear(1, 1)
        self.optimiser = torch.optim.SGD(self.field.parameters(), lr=1.0)
        self.at = at or {}
        self.counters, self.average = {"steps": 0}, None
        self.name, self.steps = "geometry", steps
        with torch.no_grad():
            self.field.weight.zero_()

    def happen(self, where: str, step: int) -> None:
        event = self.at.get((where, step))
        if isinstance(event, signal.Signals):
            os.kill(os.getpid(), event)
        elif event is not None:
            raise event

    def phase_name(self, step: int) -> str:
        return "coarse"

    def step(self, step: int) -> StepRecord:
        self.happen("step", step)
        self.counters["steps"] += 1
        with torch.no_grad():
            self.field.weight += 1
        return StepRecord({"loss": 0.0}, lambda: None)

    def check_field(self, step: int) -> dict[str, float]:
        self.happen("check", step)
        return {"volume_ratio": 1.0}


def go(stage: CountingStage, folder: Path, resume: bool = False) -> list[str]:
    said: list[str] = []
    run_stage(stage, folder, resume, quiet=True, say=said.append)  # type: ignore[arg-type]
    return said


def saved(folder: Path) -> list[int]:
    return [int(path.stem[5:]) for path in list_checkpoints(folder / "checkpoints")]


def test_checkpoints_and_rows(tmp_path: Path) -> None:
    stage = CountingStage(steps=7, every=3)
    assert go(stage, tmp_path) == []
    assert saved(tmp_path) == [6, 7] and float(stage.field.weight.detach()) == 7
    assert [row["step"] for row in read_metrics(tmp_path / "metrics.jsonl")] == list(range(1, 8))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("where", "step", "stops_after"),
    [("step", 0, 1), ("step", 3, 4), ("check", 3, 4), ("step", 5, 6)],
)
def test_signal_ends_after_a_checkpoint_wherever_it_comes(
    tmp_path: Path, number: signal.Signals, where: str, step: int, stops_after: int
) -> None:
    before = signal.getsignal(number)
    with pytest.raises(Interrupted, match=f"{number.name}: stopped after step {stops_after} of 6"):
        go(CountingStage(at={(where, step): number}), tmp_path)
    assert saved(tmp_path)[-1] == stops_after
    assert signal.getsignal(number) is before
    stage = CountingStage()
    assert go(stage, tmp_path, resume=True) == [f"resuming after step {stops_after} of 6"]
    assert float(stage.field.weight.detach()) == 6 and saved(tmp_path)[-1] == 6
    assert stage.counters == {"steps": 6}
    assert [row["step"] for row in read_metrics(tmp_path / "metrics.jsonl")] == list(range(1, 7))


@pytest.mark.parametrize("where", ["step", "check"])
def test_run_that_cannot_go_on_keeps_the_last_good_checkpoint(tmp_path: Path, where: str) -> None:
    stage = CountingStage(at={(where, 4 if where == "step" else 6): RunStopped("the part vanished; do less")})
    with pytest.raises(RunStopped, match="vanished"):
        go(stage, tmp_path)
    assert saved(tmp_path) == [3]
    assert go(CountingStage(), tmp_path, resume=True) == ["resuming after step 3 of 6"]


def test_interrupt_never_saves_a_field_that_fails_its_check(tmp_path: Path) -> None:
    events = {("step", 3): signal.SIGINT, ("check", 4): RunStopped("the field is not finite; do less")}
    with pytest.raises(RunStopped):
        go(CountingStage(at=events), tmp_path)
    assert saved(tmp_path) == [3]


def test_resume_of_nothing_and_of_a_finished_run(tmp_path: Path) -> None:
    assert go(CountingStage(), tmp_path, resume=True) == ["no checkpoint yet: starting at step 0"]
    before = list_checkpoints(tmp_path / "checkpoints")[-1].read_bytes()
    assert go(CountingStage(), tmp_path, resume=True) == ["resuming after step 6 of 6"]
    assert list_checkpoints(tmp_path / "checkpoints")[-1].read_bytes() == before


def test_works_outside_the_main_thread(tmp_path: Path) -> None:
    errors: list[BaseException] = []

    def work() -> None:
        try:
            go(CountingStage(), tmp_path)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert errors == [] and saved(tmp_path) == [3, 6]
