"""Several seeds of one edit: each grows a shape in a run folder of its own, and the best becomes the run.

RUN/tries.json             what became of each seed, and which was taken
RUN/tries/seed_4/          the geometry run of seed 4, with its own report
RUN/...                    the run of the best seed, which takes over that shape
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from fd_mitsuba.config import RunConfig
from fd_mitsuba.conventions import STAGES
from fd_mitsuba.errors import RunStopped, UserError, first_line
from fd_mitsuba.evaluation.report.run_page import reported
from fd_mitsuba.evaluation.verdict import SURE, can_be_judged, judge_run
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.json_object import read_json_object, write_json
from fd_mitsuba.runs.pipeline import run
from fd_mitsuba.runs.run_folder import TRIES_FOLDER, TRIES_RECORD, check_folder
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.record import read_metrics

_LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True)
class Try:
    """One seed. `score` is the verdict's, -1 where nothing grew; `line` is for people."""

    seed: int
    folder: str
    """Below the run folder."""
    score: float
    line: str


def run_tries(
    scene: EditScene,
    config: RunConfig,
    folder: Path,
    tries: int,
    resume: bool = False,
    command: str = "",
    quiet: bool = False,
    say: Callable[[str], None] = print,
    stages: Collection[str] = STAGES,
    opening: Sequence[str] = (),
) -> dict:
    """Grow up to `tries` shapes, with the seeds from `config.seed` on, until the built-in judge of parts is sure that
    one looks like the prompt; then run the other stages for the best. Returns what that run's `metrics.json` holds.

    Args:
        folder: the run folder; the others are those of `pipeline.run`.
        resume: go on with the tries in `folder`, perhaps with more of them; finished ones are not run again.

    Raises:
        UserError: nobody could say which try is best, a folder that holds something else, and see `pipeline.run`.
        RunStopped: no seed grew anything.
    """
    _refuse(scene, config, folder, tries, resume, stages)
    known = {one.seed: one for one in _read(folder)}
    done: list[Try] = []
    for number in range(tries):
        seed = (config.seed + number) % (_LARGEST_SEED + 1)
        attempt = config.model_copy(update={"seed": seed})
        place = folder / TRIES_FOLDER / f"seed_{seed}"
        say(f"try {number + 1} of {tries}: seed {seed}")
        done.append(_try(scene, attempt, place, folder, known.get(seed), command, quiet, say))
        _write(folder, done, None)
        if done[-1].score >= SURE:
            break
    best = max(done, key=lambda one: one.score)
    if best.score < 0:
        raise RunStopped(f"{folder}: none of {len(done)} seeds grew a part; the last: {done[-1].line}")
    say(f"seed {best.seed} is taken")
    _set_aside(folder, best.seed, say)
    chosen, source = config.model_copy(update={"seed": best.seed}), folder / best.folder
    again = (folder / "run.json").is_file()
    metrics = run(scene, chosen, folder, again, command, quiet, say, stages, source, opening=opening, judge=judge_run)
    _take_record(source, folder)
    _write(folder, done, best.seed)
    metrics["tries"] = {f"seed {one.seed}": one.line for one in done}
    write_json(folder / "metrics.json", metrics)
    return metrics


def _refuse(
    scene: EditScene, config: RunConfig, folder: Path, tries: int, resume: bool, stages: Collection[str]
) -> None:
    if tries < 1:
        raise UserError(f"--tries {tries}: give 1 or more")
    if "geometry" not in stages:
        raise UserError("--tries: shapes are tried, and --stage leaves the shape out; run all stages, or the geometry")
    if not can_be_judged(scene, config):
        raise UserError(
            f"--tries: nobody can say which try is best: the prompt {scene.prompt!r} does not ask for one part that "
            "the built-in judge knows, or nothing guides the shape; run without --tries"
        )
    if not (folder / TRIES_RECORD).is_file():
        check_folder(scene, config, folder, False)
    elif not resume:
        raise UserError(f"{folder}: holds tries already; add --resume to go on with them, or choose another -o folder")


def _try(
    scene: EditScene,
    config: RunConfig,
    place: Path,
    folder: Path,
    known: Try | None,
    command: str,
    quiet: bool,
    say: Callable[[str], None],
) -> Try:
    name = str(place.relative_to(folder))
    started = (place / "run.json").is_file()
    if started:
        check_folder(scene, config, place, True)
    metrics = read_json_object(place / "metrics.json") or {}
    if known is not None and known.score < 0:
        return known
    if "stages" not in metrics:
        try:
            with reported(place, say):
                metrics = run(scene, config, place, started, command, quiet, say, ("geometry",), judge=judge_run)
        except RunStopped as error:
            return Try(config.seed, name, -1.0, f"nothing grew: {error}")
    verdict = metrics.get("verdict") or {}
    return Try(config.seed, name, float(verdict.get("score", 0.0)), str(verdict.get("line", "no verdict")))


def _set_aside(folder: Path, seed: int, say: Callable[[str], None]) -> None:
    """Make room where an earlier call took another seed: its run goes beside the tries, whole."""
    settings = read_json_object(folder / "config.json") or {}
    if not (folder / "run.json").is_file() or settings.get("seed") == seed:
        return
    name = f"run_of_seed_{settings.get('seed')}"
    names = (name, *(f"{name}_{number}" for number in range(2, 1000)))
    places = (folder / TRIES_FOLDER / one for one in names)
    place = next(place for place in places if not (place / "run.json").exists())
    place.mkdir(parents=True, exist_ok=True)
    # The identity moves last: a call that was killed here finds it and goes on.
    inner = [path for path in folder.iterdir() if path.name not in (TRIES_FOLDER, TRIES_RECORD)]
    for path in sorted(inner, key=lambda path: (path.name == "run.json", path.name == "config.json")):
        path.rename(place / path.name)
    say(f"the run of seed {settings.get('seed')} is now in {place}")


def _take_record(source: Path, folder: Path) -> None:
    """The curves and contact sheets of the shape that was taken over."""
    own = [row for row in read_metrics(folder / "metrics.jsonl") if row.get("stage") != "geometry"]
    rows = [row for row in read_metrics(source / "metrics.jsonl") if row.get("stage") == "geometry"]
    write_atomically(folder / "metrics.jsonl", "".join(json.dumps(row) + "\n" for row in [*rows, *own]).encode())
    for sheet in (source / "images").glob("step_*.png"):
        write_atomically(folder / "images" / sheet.name, sheet.read_bytes())


def _read(folder: Path) -> list[Try]:
    record = read_json_object(folder / TRIES_RECORD) or {}
    try:
        return [Try(**one) for one in record.get("tries", ())]
    except TypeError as error:
        fault = f"tries: {first_line(error)}"
        raise UserError(
            f"{folder / TRIES_RECORD}: is damaged ({fault}); remove it and {folder / TRIES_FOLDER}"
        ) from None


def _write(folder: Path, done: list[Try], taken: int | None) -> None:
    write_json(folder / TRIES_RECORD, {"taken": taken, "tries": [asdict(one) for one in done]})
