"""The command `evaluate`: metrics of finished runs, and of the shipped scenes from nothing."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from fd_mitsuba.cli.options import machine_options, remark, say, start
from fd_mitsuba.errors import UserError

if TYPE_CHECKING:
    from fd_mitsuba.evaluation.scene_prompts import ScenePrompts


def judge_options(parser: argparse.ArgumentParser) -> None:
    """Who looks, and at what."""
    parser.add_argument(
        "--judge", metavar="MODEL", help="CLIP model by folder or hub id; default: the built-in evaluator"
    )
    parser.add_argument("--views", type=int, default=100, metavar="N", help="on a ring at 45 degrees; default: 100")
    parser.add_argument("--size", type=int, default=96, metavar="N", help="pixels a side; default: 96")
    parser.add_argument("--spp", type=int, default=16, metavar="N", help="samples a pixel; default: 16")


def batch_options(parser: argparse.ArgumentParser, folder: str, default: str | None, seeds: list[int]) -> None:
    """What to run first; `folder` is the default as the help names it."""
    parser.add_argument("-c", "--config", default="quick", metavar="FILE|NAME", help="default: %(default)s")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one setting"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=seeds, metavar="N", help="default: %(default)s")
    parser.add_argument("-o", "--output", default=default, metavar="FOLDER", help=f"of these runs; default: {folder}")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="runs at a time; default: 1")


def add_evaluate_commands(commands: argparse._SubParsersAction) -> None:
    """Put `evaluate` beside the other commands."""
    evaluate = commands.add_parser("evaluate", help="metrics of finished runs: CLIP scores, base, part, cost")
    evaluate.add_argument(
        "runs", nargs="*", metavar="RUN", help="run folders; a scene file is run first, by the options below"
    )
    evaluate.add_argument(
        "--all", action="store_true", help="every shipped scene that the guidance model can read, run if need be"
    )
    evaluate.add_argument(
        "--stage",
        choices=("all", "geometry"),
        default="all",
        help="geometry: scenes are run without appearance, in less than half of the time; default: all",
    )
    judge_options(evaluate)
    evaluate.add_argument(
        "--pictures",
        choices=("auto", "lit", "shape"),
        default="auto",
        help="lit by the scene, or the bare shape; default: lit where there is an appearance",
    )
    batch_options(evaluate, "runs/evaluate", "runs/evaluate", [0, 1, 2])
    evaluate.add_argument(
        "--scenes", default="scenes", metavar="FOLDER", help="whose prompts are the rivals; default: %(default)s"
    )
    evaluate.add_argument("--again", action="store_true", help="also what is evaluated already")
    evaluate.add_argument("--json", metavar="FILE", help="write all metrics of all runs")
    evaluate.add_argument("--markdown", metavar="FILE", help="write the table")
    machine_options(evaluate)
    evaluate.set_defaults(call=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    if options.all == bool(options.runs):
        raise UserError("evaluate: give run folders or scene files, or --all")
    start(options)
    from rich.console import Console

    from fd_mitsuba.evaluation.clip import ClipJudge
    from fd_mitsuba.evaluation.report.score_table import COLUMNS, SHORT, header, rich_table, score_rows, summary_lines
    from fd_mitsuba.evaluation.run_evaluation import Protocol, evaluate_run
    from fd_mitsuba.evaluation.scene_prompts import prompts_of_scenes
    from fd_mitsuba.evaluation.side_processes import evaluate_at_once
    from fd_mitsuba.io.atomic import write_atomically

    protocol = Protocol(options.views, options.size, options.spp, options.pictures)
    judge = ClipJudge.load(options.judge)
    rivals = prompts_of_scenes(Path(options.scenes)) if options.all or Path(options.scenes).is_dir() else []
    runs, scenes = [Path(run) for run in options.runs], []
    if options.all:
        scenes = _readable_scenes(options, rivals)
    else:
        scenes = [run for run in runs if _is_scene(run)]
        runs = [run for run in runs if not _is_scene(run)]
    failed = 0
    if scenes:
        made, failed = run_scenes(options, scenes)
        runs += made
    again = options.again
    if options.workers > 1 and len(runs) > 1:
        again = not evaluate_at_once(runs, options.workers, _as_given(options)) and again
    results = []
    for run in runs:
        try:
            results.append(evaluate_run(run, judge, protocol, rivals, again, remark))
        except UserError as error:
            if len(runs) == 1:
                raise
            failed += 1
            remark(f"error: {error}")
    if options.json:
        write_atomically(Path(options.json), (json.dumps({"runs": results}, indent=2) + "\n").encode())
    if options.markdown:
        write_atomically(Path(options.markdown), _document(results).encode())
    shown = [COLUMNS[name] for name in SHORT]
    Console(width=None if os.isatty(1) else 200).print(rich_table(header(shown), score_rows(results, shown)))
    for line in summary_lines(results):
        say(line)
    return 1 if failed else 0


def _document(results: list[dict]) -> str:
    """Markdown: what holds in how many runs, a table by scene where there are several seeds, a table of all runs."""
    from fd_mitsuba.evaluation.report.score_table import (
        COLUMNS,
        header,
        markdown_table,
        scene_rows,
        score_rows,
        summary_lines,
    )

    columns = list(COLUMNS.values())
    blocks = ["".join(f"- {line}\n" for line in summary_lines(results))]
    if len({found["scene"] for found in results}) < len(results):
        titles = ["runs" if title == "seed" else title for title in header(columns)]
        blocks.append(markdown_table(titles, scene_rows(results, columns)))
    return "\n".join([*blocks, markdown_table(header(columns), score_rows(results, columns))])


def _as_given(options: argparse.Namespace) -> list[str]:
    """The options that decide how runs are evaluated, for another process."""
    words = ["--again"] if options.again else []
    for name in ("judge", "views", "size", "spp", "pictures", "scenes", "variant"):
        value = getattr(options, name)
        words += [] if value is None else [f"--{name}", str(value)]
    for module in options.plugins:
        words += ["--plugin", module]
    return words


def _readable_scenes(options: argparse.Namespace, shipped: list[ScenePrompts]) -> list[Path]:
    """The shipped scenes that the settings' guidance model can read; a line tells why the others are left out."""
    from fd_mitsuba.config import RunConfig
    from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
    from fd_mitsuba.guidance.prompt_reader import read_prompt

    model = RunConfig.load(Path(options.config), options.overrides).guidance.model
    vocabulary = vocabulary_of(model)
    chosen = []
    for found in shipped:
        if vocabulary is None or found.known_to(vocabulary):
            chosen.append(found.scene)
        else:
            words = ", ".join(map(repr, read_prompt(found.words.prompt, vocabulary).ignored))
            remark(
                f"{found.name}: left out, since {model} does not know {words or 'its part'}; "
                "give --set guidance.model=<folder or hub id> of a Stable Diffusion"
            )
    return chosen


def run_scenes(options: argparse.Namespace, scenes: list[Path]) -> tuple[list[Path], int]:
    """Run what is missing of scenes by seeds; the folders of the finished runs, and how many failed."""
    from fd_mitsuba.batch.local import job_matrix, run_batch

    folder = Path(options.output)
    jobs = job_matrix(
        scenes,
        [Path(options.config)],
        options.seeds,
        options.overrides,
        folder,
        stage=options.stage,
        plugins=options.plugins,
    )
    # One seed after the other, so that a batch that is stopped has something of every scene.
    jobs.sort(key=lambda job: options.seeds.index(job.seed))
    outcomes = run_batch(jobs, options.workers, remark, record=folder / "batch.json")
    done = [outcome.job.folder for outcome in outcomes if outcome.state in ("finished", "skipped")]
    return done, len(outcomes) - len(done)


def _is_scene(path: Path) -> bool:
    return path.suffix == ".xml" or ((path / "scene.xml").is_file() and not (path / "run.json").is_file())
