"""The command `check`."""

from __future__ import annotations

import argparse
import json

from fd_mitsuba.backend.collector import uncollected
from fd_mitsuba.cli.options import say
from fd_mitsuba.cli.scene_options import chosen_settings, load, scene_options, settings_options
from fd_mitsuba.errors import UserError


def add_check_command(commands: argparse._SubParsersAction) -> None:
    """Put `check` beside the other commands."""
    check = commands.add_parser("check", help="examine a scene before a run")
    scene_options(check)
    settings_options(check)
    check.add_argument("--json", action="store_true", help="machine-readable")
    check.set_defaults(call=_check, writes_nothing=True)


@uncollected()  # most of a check is imports
def _check(options: argparse.Namespace) -> int:
    settings = chosen_settings(options)
    scene = load(options, config=settings.config)
    from fd_mitsuba.runs.check import check_scene

    report = check_scene(scene, settings.config)
    if options.json:
        print(json.dumps(report.to_json(), indent=2))
    else:
        if settings.remark:
            say(settings.remark.replace(": ", " ", 1))
        say("\n".join(report.lines()))
    if report.refusal is not None:
        raise UserError(report.refusal)
    return 0
