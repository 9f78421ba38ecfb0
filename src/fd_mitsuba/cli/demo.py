"""The command `demo`: a first run without any file of the user's own."""

from __future__ import annotations

import argparse

from fd_mitsuba.cli.run import run_options, run_scene
from fd_mitsuba.cli.scene_options import scene_changes


def add_demo_command(commands: argparse._SubParsersAction) -> None:
    """Put `demo` beside the other commands."""
    demo = commands.add_parser("demo", help="grow a crown on the shipped cat; takes the options of run")
    scene_changes(demo)
    run_options(demo, "runs/demo")
    demo.set_defaults(call=_demo)


def _demo(options: argparse.Namespace) -> int:
    from fd_mitsuba.api import demo_scene

    options.scene = str(demo_scene())
    options.output = options.output or "runs/demo"
    return run_scene(options)
