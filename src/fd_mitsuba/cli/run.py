"""The command `run`."""

from __future__ import annotations

import argparse
from pathlib import Path

from fd_mitsuba.cli.options import remark
from fd_mitsuba.cli.scene_options import chosen_settings, load, scene_options, settings_options


def add_run_command(commands: argparse._SubParsersAction) -> None:
    """Put `run` beside the other commands."""
    run = commands.add_parser("run", help="grow the part that the scene asks for")
    scene_options(run)
    settings_options(run)
    run.add_argument("-o", "--output", metavar="FOLDER", help="run folder; default: runs/<scene>")
    run.add_argument(
        "--stage", choices=("all", "geometry", "appearance"), default="all", help="default: all, one after the other"
    )
    run.add_argument(
        "--from", dest="geometry_from", metavar="RUN", help="take the finished geometry of another run of this scene"
    )
    run.add_argument("--resume", action="store_true", help="go on with an interrupted run in the output folder")
    run.add_argument("-q", "--quiet", action="store_true", help="no progress display")
    run.set_defaults(call=_run, resumable=True)


def _run(options: argparse.Namespace) -> int:
    config = chosen_settings(options)
    scene = load(options, config=config)
    from fd_mitsuba.api import STAGES, edit

    run = edit(
        scene,
        config,
        output=options.output or Path("runs") / Path(options.scene).resolve().parent.name,
        resume=options.resume,
        quiet=options.quiet,
        stages=STAGES if options.stage == "all" else (options.stage,),
        geometry_from=options.geometry_from,
        say=remark,
        command=options.command_line,
    )
    metrics = run.metrics
    picture = "appearance" if "appearance" in metrics else "turntable"
    print(f"{run.folder}: part in export/, pictures in images/{picture}.png, all in report.html")
    print(
        f"inside the region {metrics['inside_fraction']:.1%}, overlap with the base {metrics['overlap_fraction']:.1%}, "
        f"base identical: {metrics['base_identical']}, {metrics['seconds']:.0f} s"
    )
    return 0
