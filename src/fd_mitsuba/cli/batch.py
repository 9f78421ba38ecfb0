"""The command `batch`: many runs, resumable."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from fd_mitsuba.cli.options import plugin_option, remark, say
from fd_mitsuba.errors import UserError


def add_batch_commands(commands: argparse._SubParsersAction) -> None:
    """Put `batch` beside the other commands."""
    batch = commands.add_parser("batch", help="scenes x settings x seeds, each a run folder; finished ones are skipped")
    batch.add_argument("scenes", nargs="+", metavar="SCENE", help="scene files, or folders with a scene.xml")
    batch.add_argument("-c", "--config", nargs="+", default=[], metavar="FILE", help="settings; default: the paper's")
    batch.add_argument("--seeds", nargs="+", type=int, metavar="N", help="default: the one in the settings")
    batch.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE", help="for all runs"
    )
    batch.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in all scenes"
    )
    batch.add_argument("--stage", choices=("all", "geometry"), default="all", help="default: all")
    batch.add_argument("-o", "--output", required=True, metavar="FOLDER", help="holds FOLDER/<scene>-<config>-<seed>")
    batch.add_argument("--workers", type=int, default=1, metavar="N", help="runs at a time; default: 1")
    batch.add_argument(
        "--ray", nargs="?", const="local", metavar="ADDRESS", help="on Ray: of this machine, or the cluster at ADDRESS"
    )
    batch.add_argument(
        "--retries", type=int, default=1, metavar="N", help="for a run that a signal has ended; default: 1"
    )
    batch.add_argument("-t", "--threads", type=int, metavar="N", help="for a run; default: the cores, shared out")
    plugin_option(batch)
    batch.add_argument("-v", "--verbose", action="store_true", help="tracebacks")
    batch.set_defaults(call=_batch)


def _batch(options: argparse.Namespace) -> int:
    from rich.console import Console

    from fd_mitsuba.backend.threads import most_threads
    from fd_mitsuba.batch.local import job_matrix, run_batch
    from fd_mitsuba.batch.record import print_table

    if options.threads is not None and not 1 <= options.threads <= most_threads():
        raise UserError(f"-t {options.threads}: give 1 to {most_threads()}")
    folder = Path(options.output)
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; choose another -o folder")
    jobs = job_matrix(
        [Path(scene) for scene in options.scenes],
        [Path(config) for config in options.config],
        options.seeds,
        options.overrides,
        folder,
        options.definitions,
        options.stage,
        options.plugins,
    )
    outcomes = run_batch(
        jobs,
        options.workers,
        remark,
        options.ray,
        retries=options.retries,
        threads=options.threads,
        record=folder / "batch.json",
    )
    print_table(outcomes, Console(width=None if os.isatty(1) else 200))
    runs = [outcome.job.folder for outcome in outcomes if (outcome.job.folder / "run.json").is_file()]
    if runs:
        from fd_mitsuba.evaluation.report.gallery import write_gallery

        say(write_gallery(runs, folder / "gallery.html", folder.resolve().name, remark))
    states = {outcome.state for outcome in outcomes}
    if "interrupted" in states:
        remark("interrupted; repeat the command to go on")
        return 130
    return 1 if "failed" in states else 0
