"""The command `compare`: this method beside the systems that the paper compares it with."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fd_mitsuba.cli.options import definitions, machine_options, remark, say, start
from fd_mitsuba.cli.scene_options import chosen_settings, settings_options
from fd_mitsuba.errors import UserError

if TYPE_CHECKING:
    from fd_mitsuba.baselines.jobs import CompareJob
    from fd_mitsuba.baselines.measuring import CompareProtocol
    from fd_mitsuba.baselines.processes import CompareProcess
    from fd_mitsuba.config.choice import Choice
    from fd_mitsuba.evaluation.similarity import Judge

_DEFAULT_METHODS = ["focaldreamer", "fantasia3d", "voxe_global", "voxe"]


def add_compare_command(commands: argparse._SubParsersAction) -> None:
    """Put `compare` beside the other commands."""
    compare = commands.add_parser("compare", help="the same edits by this method and by others, as a table and figures")
    compare.add_argument("scenes", nargs="+", metavar="SCENE", help="scene files, or folders with a scene.xml")
    compare.add_argument(
        "--methods",
        nargs="+",
        default=_DEFAULT_METHODS,
        metavar="METHOD",
        help="names, with settings as in 'voxe_global {resolution = 48}'; default: those of the paper's Table 1",
    )
    compare.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="N", help="default: %(default)s")
    compare.add_argument("-o", "--output", default="runs/compare", metavar="FOLDER", help="default: %(default)s")
    compare.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scenes"
    )
    settings_options(compare)
    compare.add_argument(
        "--judge", metavar="MODEL", help="CLIP model by folder or hub id; default: the built-in evaluator"
    )
    compare.add_argument("--views", type=int, default=24, metavar="N", help="on a ring at 45 degrees; default: 24")
    compare.add_argument("--size", type=int, default=96, metavar="N", help="pixels a side; default: 96")
    compare.add_argument(
        "--workers", type=int, default=1, metavar="N", help="jobs at a time, each a process of a batch; default: 1"
    )
    # What such a process is given: one job, and no table of it.
    compare.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    machine_options(compare)
    compare.set_defaults(call=_compare, resumable=False)


def _compare(options: argparse.Namespace) -> int:
    start(options)
    from rich.console import Console

    from fd_mitsuba.baselines.compare import compare, compare_jobs
    from fd_mitsuba.baselines.measuring import CompareProtocol
    from fd_mitsuba.baselines.processes import run_processes
    from fd_mitsuba.baselines.table import compare_header, compare_rows
    from fd_mitsuba.config import misfits
    from fd_mitsuba.config.toml_reading import read_choice
    from fd_mitsuba.evaluation.clip import ClipJudge
    from fd_mitsuba.evaluation.report.score_table import rich_table

    chosen, folder = chosen_settings(options), Path(options.output)
    protocol = CompareProtocol(options.views, options.size)
    methods = [read_choice(item) for item in options.methods]
    jobs = compare_jobs(
        [Path(scene) for scene in options.scenes], methods, options.seeds, chosen.config, folder, definitions(options)
    )
    judge = ClipJudge.load(options.judge)
    for line in [chosen.remark, *(f"warning: {line}" for line in misfits(chosen.config))]:
        if line:
            remark(line)
    if options.one:
        return _one(jobs, judge, protocol, not options.verbose)
    tried: dict[str, str] = {}
    if options.workers != 1:
        threads = options.threads or None
        process = process_of(options, methods)
        outcomes = run_processes(jobs, process, judge, protocol, folder, options.workers, threads, remark)
        if any(outcome.state == "interrupted" for outcome in outcomes):
            remark("interrupted; repeat the command to go on")
            return 130
        tried = {outcome.job.name: outcome.message for outcome in outcomes if outcome.state == "failed"}
    found = compare(jobs, judge, protocol, folder, remark, not options.verbose, tried)
    table = rich_table(compare_header(), compare_rows(found.results, found.methods), f"judge: {judge.name}")
    Console(width=None if os.isatty(1) else 220).print(table)
    say(f"{folder}: compare.html, compare.json, compare.md, compare.png")
    return 0 if found.whole else 1


def process_of(options: argparse.Namespace, methods: list[Choice]) -> Callable[[CompareJob], CompareProcess]:
    """What makes a job's process of the options that this one was given."""
    from fd_mitsuba.baselines.processes import CompareProcess

    given = {method.kind: text for method, text in zip(methods, options.methods, strict=True)}
    config = None if options.config is None else Path(options.config)

    def process(job: CompareJob) -> CompareProcess:
        return CompareProcess(
            job.scene.path, config, job.config.seed, tuple(options.overrides), job.folder, tuple(options.definitions),
            plugins=tuple(options.plugins), method=given[job.method.kind], judge=options.judge, views=options.views,
            size=options.size, variant=options.variant,
        )  # fmt: skip

    return process


def _one(jobs: list[CompareJob], judge: Judge, protocol: CompareProtocol, quiet: bool) -> int:
    from fd_mitsuba.baselines.jobs import perform

    for job in jobs:
        outcome = perform(job, judge, protocol, remark, quiet)
        if outcome.result is None:
            raise UserError(outcome.message)
    return 0
