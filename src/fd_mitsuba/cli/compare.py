"""The command `compare`: this method beside the systems that the paper compares it with."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from fd_mitsuba.cli.options import definitions, machine_options, remark, say, start
from fd_mitsuba.cli.scene_options import chosen_settings, settings_options

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
        help="names, with settings as in 'voxe_global {resolution = 48}'; default: all that edit objects",
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
    machine_options(compare)
    compare.set_defaults(call=_compare, resumable=False)


def _compare(options: argparse.Namespace) -> int:
    start(options)
    from rich.console import Console

    from fd_mitsuba.baselines.compare import compare, compare_jobs
    from fd_mitsuba.baselines.measuring import CompareProtocol
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
    found = compare(jobs, judge, protocol, folder, remark, not options.verbose)
    table = rich_table(compare_header(), compare_rows(found.results, found.methods), f"judge: {judge.name}")
    Console(width=None if os.isatty(1) else 220).print(table)
    say(f"{folder}: compare.json, compare.md, compare.png")
    return 0 if found.whole else 1
