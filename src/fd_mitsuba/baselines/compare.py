"""Scenes x methods x seeds, one after the other; what is finished is not done again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fd_mitsuba.baselines.figures import write_comparison, write_views
from fd_mitsuba.baselines.jobs import FAILED, FINISHED, CompareJob, JobOutcome, perform
from fd_mitsuba.baselines.measuring import CompareProtocol
from fd_mitsuba.baselines.methods import BASELINES
from fd_mitsuba.baselines.page import write_page
from fd_mitsuba.baselines.table import compare_header, compare_rows
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.report.score_table import markdown_table
from fd_mitsuba.evaluation.similarity import Judge
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.json_object import write_json
from fd_mitsuba.runs.choices import checked_choices
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene

IMAGE_EDITORS = {"pix2pix_2d": "InstructPix2Pix, view by view", "inpaint_2d": "inpainting, view by view"}
"""Methods that edit single images, and what they are called in their figure."""


@dataclass(frozen=True)
class Comparison:
    """What a comparison found.

    Attributes:
        outcomes: one for each job, in their order.
        methods: names, in the order in which they were asked for.
    """

    outcomes: tuple[JobOutcome, ...]
    methods: tuple[str, ...]

    @property
    def results(self) -> list[dict[str, Any]]:
        """Of the jobs that have one."""
        return [outcome.result for outcome in self.outcomes if outcome.result is not None]

    @property
    def whole(self) -> bool:
        """Whether every job has a result."""
        return all(outcome.state != FAILED for outcome in self.outcomes)


def compare_jobs(
    scenes: Sequence[Path],
    methods: Sequence[Choice],
    seeds: Sequence[int],
    config: RunConfig,
    folder: Path,
    parameters: dict[str, str] | None = None,
) -> list[CompareJob]:
    """A job for each seed, scene and method, in `folder/<scene>-<method>-<seed>`; all input is checked here.

    Args:
        scenes: scene files, or folders with a `scene.xml`.
        methods: names and settings, each name once.
        config: settings of every run; its seed is replaced.
        parameters: values for `$name` in the scenes.

    Raises:
        UserError: an unknown method or setting, a scene that cannot be read or that cuts, a name that is there twice.
    """
    chosen = [BASELINES.completed(method, "--methods") for method in methods]
    names = [method.kind for method in chosen]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UserError(f"--methods {twice}: is named twice; compare two settings of a method in two folders")
    if not chosen or not scenes or not seeds:
        raise UserError("compare: give at least one scene, one method and one seed")
    config = checked_choices(config)
    loaded: dict[str, EditScene] = {}
    for given in scenes:
        path = given / "scene.xml" if given.is_dir() else given
        if not path.is_file():
            raise UserError(f"{path}: no such scene; give a scene file or a folder with a scene.xml")
        name = path.resolve().parent.name if path.stem == "scene" else path.stem
        if name in loaded:
            raise UserError(f"{path}: a scene of this comparison is called {name!r} already; rename one")
        loaded[name] = load_edit_scene(path, dict(parameters or {}))
        if loaded[name].subtracts:
            raise UserError(f"{path}: cuts something out of its base; only scenes that add are compared")
    return [
        CompareJob(
            scene, name, method, config.model_copy(update={"seed": seed}), folder / f"{name}-{method.kind}-{seed}"
        )
        for seed in seeds  # so that a comparison that is stopped has something of every scene and method
        for name, scene in loaded.items()
        for method in chosen
    ]


def compare(
    jobs: Sequence[CompareJob],
    judge: Judge,
    protocol: CompareProtocol,
    folder: Path,
    say: Callable[[str], None] = print,
    quiet: bool = True,
    tried: Mapping[str, str] | None = None,
) -> Comparison:
    """Do what is missing, and write `compare.json`, `.md`, `.html`, `.png` and `compare_2d.png` into `folder`.

    A method that fails on a scene is said in one line, and the others go on. The files are brought up to date after
    every job.

    Args:
        tried: name -> message of jobs that were tried elsewhere and failed: they are not tried again.

    Raises:
        Interrupted: SIGINT or SIGTERM; the same call goes on.
    """
    methods = tuple(dict.fromkeys(job.method.kind for job in jobs))
    outcomes: list[JobOutcome] = []
    for number, job in enumerate(jobs, 1):
        if tried is not None and job.name in tried:
            outcome = JobOutcome(job, FAILED, tried[job.name], None)
        else:
            outcome = perform(job, judge, protocol, say, quiet)
        outcomes.append(outcome)
        took = ""
        if outcome.state == FINISHED and outcome.result is not None:
            took = f" in {outcome.result['cost']['seconds']:.0f} s"
        said = f": {outcome.message}" if outcome.message else ""
        say(f"[{number}/{len(jobs)}] {job.name}: {outcome.state}{took}{said}")
        _write(Comparison(tuple(outcomes), methods), judge, protocol, folder)
    return Comparison(tuple(outcomes), methods)


def _write(found: Comparison, judge: Judge, protocol: CompareProtocol, folder: Path) -> None:
    about = {"judge": judge.name, "views": protocol.views, "size": protocol.size, "methods": list(found.methods)}
    jobs = [
        {"name": outcome.job.name, "state": outcome.state, "message": outcome.message, "result": outcome.result}
        for outcome in found.outcomes
    ]
    write_json(folder / "compare.json", about | {"jobs": jobs})
    note = (
        f"Judge: {judge.name}; {protocol.views} views of {protocol.size} pixels; mean ± standard deviation over scenes "
        "and seeds. The paper's numbers are ViT-B/32's over its own scenes."
    )
    header, rows = compare_header(), compare_rows(found.results, found.methods)
    write_atomically(folder / "compare.md", f"{note}\n\n{markdown_table(header, rows)}".encode())
    write_comparison(found.outcomes, folder / "compare.png")
    write_views(found.outcomes, IMAGE_EDITORS, folder / "compare_2d.png")
    write_page(found.outcomes, header, rows, note, folder)
