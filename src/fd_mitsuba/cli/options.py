"""What several commands have in common: options of the machine, `-D`, remarks, the start of Mitsuba."""

from __future__ import annotations

import argparse
import os
import sys
import warnings

from fd_mitsuba.backend.startup import DEFAULT_VARIANT
from fd_mitsuba.errors import UserError


def machine_options(parser: argparse.ArgumentParser) -> None:
    """-m, -t, --plugin and -v."""
    parser.add_argument("-m", "--variant", default=DEFAULT_VARIANT, help="Mitsuba variant")
    parser.add_argument(
        "-t", "--threads", type=int, default=0, metavar="N", help="threads; 0: all cores, 1: bit-reproducible"
    )
    plugin_option(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="tracebacks and library warnings")


def plugin_option(parser: argparse.ArgumentParser) -> None:
    """--plugin."""
    parser.add_argument(
        "--plugin",
        dest="plugins",
        action="append",
        default=[],
        metavar="MODULE",
        help="import a module or .py file that you trust, which registers losses, formats and the like",
    )


def remark(line: str) -> None:
    """Say something on stderr."""
    print(f"fd_mitsuba: {line}", file=sys.stderr)


def definitions(options: argparse.Namespace) -> dict[str, str]:
    """The `-D` values by name."""
    parameters = {}
    for item in options.definitions:
        name, separator, value = item.partition("=")
        if not separator or not name:
            raise UserError(f"-D {item}: write -D name=value")
        parameters[name] = value
    return parameters


def start(options: argparse.Namespace) -> None:
    """Start Mitsuba as the options say."""
    quiet_libraries(options)
    from fd_mitsuba.backend.threads import share_cores

    share_cores(options.threads, options.variant)
    from fd_mitsuba.config.registry import load_plugins

    load_plugins(options.plugins)


def quiet_libraries(options: argparse.Namespace) -> None:
    """Without -v, other libraries keep their warnings to themselves; UserError for a number of threads below 0."""
    if options.threads < 0:
        raise UserError(f"-t {options.threads}: give 0 (all cores) or a positive number")
    if not options.verbose:
        warnings.filterwarnings("ignore")
        os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
        os.environ.setdefault("DIFFUSERS_VERBOSITY", "error")
