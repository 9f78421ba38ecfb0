"""The command `run`."""

from __future__ import annotations

import argparse
from pathlib import Path

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.cli.given_scene import scene_label
from fd_mitsuba.cli.options import remark, say
from fd_mitsuba.cli.scene_options import chosen_settings, load, scene_options, settings_options


def add_run_command(commands: argparse._SubParsersAction) -> None:
    """Put `run` beside the other commands."""
    run = commands.add_parser("run", help="grow the part that the scene asks for")
    scene_options(run)
    run_options(run, "runs/<scene>")
    run.set_defaults(call=run_scene)


def run_options(parser: argparse.ArgumentParser, folder: str) -> None:
    """Settings, output and stages of a run; `folder` is the default output as the help names it."""
    settings_options(parser)
    parser.add_argument("-o", "--output", metavar="FOLDER", help=f"run folder; default: {folder}")
    parser.add_argument(
        "--stage", choices=("all", "geometry", "appearance"), default="all", help="default: all, one after the other"
    )
    parser.add_argument(
        "--from", dest="geometry_from", metavar="RUN", help="take the finished geometry of another run of this scene"
    )
    parser.add_argument(
        "--tries", type=int, metavar="N", help="grow up to N seeds, keep the one that looks most like the prompt"
    )
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted run in the output folder")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress display")
    parser.set_defaults(resumable=True)


def run_scene(options: argparse.Namespace) -> int:
    """Edit `options.scene`, print where the result is and how good it is."""
    settings = chosen_settings(options)
    folder = Path(options.output) if options.output else Path("runs") / scene_label(options.scene)
    if options.resume:
        from fd_mitsuba.runs.resumed_scene import resumed_scene

        options.scene, options.regions = resumed_scene(folder, options.scene, options.regions, remark)
    scene = load(options, config=settings.config, beside=folder)
    from fd_mitsuba.api import edit
    from fd_mitsuba.conventions import STAGES

    run = edit(
        scene,
        settings,
        output=folder,
        resume=options.resume,
        quiet=options.quiet,
        stages=STAGES if options.stage == "all" else (options.stage,),
        geometry_from=options.geometry_from,
        tries=options.tries,
        log=remark,
        command=options.command_line,
    )
    if not processes().writes:
        return 0
    metrics = run.metrics
    picture = "appearance" if "appearance" in metrics else "turntable"
    say(f"{run.folder}: part in export/, images in images/{picture}.png, all in report.html")
    say(
        f"inside the region {metrics['inside_fraction']:.1%}, overlap with the base {metrics['overlap_fraction']:.1%}, "
        f"base identical: {metrics['base_identical']}, {metrics['seconds']:.0f} s"
    )
    return 0
