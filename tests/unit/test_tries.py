"""Several seeds of one edit, with runs that are only written down: which is taken, what a second call does anew."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import Interrupted, RunStopped, UserError
from fd_mitsuba.evaluation import tries
from fd_mitsuba.evaluation.tries import run_tries
from fd_mitsuba.runs.run_folder import check_folder, describe_run
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.training.record import read_metrics

PROMPT = '<integrator type="dual_path"><string name="prompt" value="a pig with two wings"/></integrator>'
ROWS = {"stage": "geometry", "step": 1}


@pytest.fixture
def scene(make_scene: Callable[..., Path]) -> EditScene:
    return load_edit_scene(make_scene(integrator=PROMPT))


class Runs:
    """In place of `pipeline.run`: each seed has a share, or an error that ends it."""

    def __init__(self, outcomes: dict[int, float | Exception]) -> None:
        self.outcomes, self.calls = outcomes, []

    def __call__(
        self, scene, config, folder, resume, command, quiet, say, stages, geometry_from=None, opening=(), judge=None
    ) -> dict:  # fmt: skip
        check_folder(scene, config, folder, resume)
        self.calls.append((config.seed, folder.name, tuple(stages), geometry_from and geometry_from.name))
        outcome = self.outcomes[config.seed]
        if isinstance(outcome, RunStopped):
            raise outcome
        describe_run(scene, config, folder, command)
        if isinstance(outcome, Exception):
            raise outcome
        (folder / "metrics.jsonl").write_text(json.dumps(ROWS if geometry_from is None else {"stage": "appearance"}))
        verdict = {"part": "wings", "score": outcome, "line": f"wings {outcome}"}
        metrics = {"verdict": verdict, "stages": {}, "seed": config.seed}
        (folder / "metrics.json").write_text(json.dumps(metrics))
        return metrics

    @property
    def seeds(self) -> list[int]:
        return [seed for seed, _, _, source in self.calls if source is None]


def call(monkeypatch: pytest.MonkeyPatch, runs: Runs, scene: EditScene, folder: Path, count: int, **more) -> dict:
    monkeypatch.setattr(tries, "run", runs)
    config = more.pop("config", RunConfig(seed=5))
    return run_tries(scene, config, folder, count, say=lambda line: None, **more)


def taken(folder: Path) -> int | None:
    return json.loads((folder / "tries.json").read_text())["taken"]


def test_the_best_becomes_the_run(scene: EditScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, folder = Runs({5: 0.3, 6: 0.6, 7: 0.1}), tmp_path / "out"
    metrics = call(monkeypatch, runs, scene, folder, 3)
    assert runs.calls == [
        (5, "seed_5", ("geometry",), None),
        (6, "seed_6", ("geometry",), None),
        (7, "seed_7", ("geometry",), None),
        (6, "out", ("geometry", "appearance"), "seed_6"),
    ]
    assert taken(folder) == 6 and metrics["tries"] == {
        "seed 5": "wings 0.3",
        "seed 6": "wings 0.6",
        "seed 7": "wings 0.1",
    }
    assert json.loads((folder / "config.json").read_text())["seed"] == 6
    assert [row["stage"] for row in read_metrics(folder / "metrics.jsonl")] == ["geometry", "appearance"]
    assert all((folder / "tries" / f"seed_{seed}" / "report.html").is_file() for seed in (5, 6, 7))


def test_the_first_sure_one_ends_it(scene: EditScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = Runs({5: 0.7, 6: 0.9, 7: 1.0})
    call(monkeypatch, runs, scene, tmp_path / "out", 3)
    assert runs.seeds == [5, 6] and taken(tmp_path / "out") == 6


def test_a_seed_that_grows_nothing_is_passed_over(
    scene: EditScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = RunStopped("step 10: the part vanished")
    metrics = call(monkeypatch, Runs({5: stopped, 6: 0.2}), scene, tmp_path / "out", 2)
    assert taken(tmp_path / "out") == 6 and metrics["tries"]["seed 5"].startswith("nothing grew: step 10")
    with pytest.raises(RunStopped, match="none of 2 seeds grew a part"):
        call(monkeypatch, Runs({5: stopped, 6: stopped}), scene, tmp_path / "none", 2)


def test_an_interrupted_call_goes_on(scene: EditScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "out"
    with pytest.raises(Interrupted):
        call(monkeypatch, Runs({5: 0.3, 6: Interrupted("stopped")}), scene, folder, 2)
    with pytest.raises(UserError, match="--resume"):
        call(monkeypatch, Runs({}), scene, folder, 2)
    runs = Runs({5: 0.3, 6: 0.1})
    call(monkeypatch, runs, scene, folder, 2, resume=True)
    assert runs.seeds == [6] and taken(folder) == 5
    # More tries later: the finished ones stand, and the run of the earlier best is kept.
    (folder / "export").mkdir()
    more = Runs({5: 0.3, 6: 0.1, 7: 0.8})
    call(monkeypatch, more, scene, folder, 3, resume=True)
    assert more.seeds == [7] and taken(folder) == 7
    assert (folder / "tries" / "run_of_seed_5" / "export").is_dir() and not (folder / "export").exists()
    with pytest.raises(UserError, match="other settings"):
        call(
            monkeypatch,
            Runs({}),
            scene,
            folder,
            3,
            resume=True,
            config=RunConfig.load(None, ["seed=5", "geometry.steps=9"]),
        )


def test_what_cannot_be_tried_is_refused(scene: EditScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unguided = RunConfig.load(None, ["geometry.lambda_sds=0"])
    for words, more in {
        "give 1 or more": {"count": 0},
        "leaves the shape out": {"stages": ("appearance",)},
        "which try is best": {"config": unguided},
    }.items():
        with pytest.raises(UserError, match=words):
            call(monkeypatch, Runs({}), scene, tmp_path / "out", more.pop("count", 2), **more)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(UserError, match="not empty and not a run"):
        call(monkeypatch, Runs({}), scene, tmp_path / "mine", 2)
    assert not (tmp_path / "out").exists()
