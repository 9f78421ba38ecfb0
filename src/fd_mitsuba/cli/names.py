"""The command `names`: what settings and scenes can name, from this package and from others."""

from __future__ import annotations

import argparse
import json

from fd_mitsuba.cli.options import machine_options, start
from fd_mitsuba.cli.scene_options import chosen_settings, settings_options


def add_names_command(commands: argparse._SubParsersAction) -> None:
    """Put `names` beside the other commands."""
    names = commands.add_parser("names", help="what settings and scenes can name: losses, formats, shapes, methods")
    settings_options(names)
    machine_options(names)
    names.add_argument("--json", action="store_true", help="machine-readable")
    names.set_defaults(call=_names)


def _names(options: argparse.Namespace) -> int:
    config = chosen_settings(options).config if options.config or options.overrides else None
    options.plugins = list(options.plugins if config is None else config.plugins)
    start(options)
    from fd_mitsuba.baselines.methods import BASELINES
    from fd_mitsuba.runs.choices import checked_choices, described

    if config is not None:
        checked_choices(config)
    found = described([BASELINES])
    if options.json:
        print(json.dumps(found, indent=2))
        return 0
    for kind, entries in found.items():
        print(kind)
        for name, entry in entries.items():
            own = ", ".join(f"{key} = {json.dumps(value)}" for key, value in entry["settings"].items())
            print(f"  {name}: {entry['about']}" + (f" [{own}]" if own else ""))
    return 0
