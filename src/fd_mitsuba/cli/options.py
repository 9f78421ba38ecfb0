"""What several commands have in common: options of the machine, `-D`, lines on stderr, the start of Mitsuba."""

from __future__ import annotations

import argparse
import os
import sys
import warnings

from fd_mitsuba.backend.startup import DEFAULT_VARIANT
from fd_mitsuba.errors import UserError, printable


def machine_options(parser: argparse.ArgumentParser) -> None:
    """-m, -t, --plugin and -v."""
    parser.add_argument("-m", "--variant", default=DEFAULT_VARIANT, help="Mitsuba variant")
    parser.add_argument(
        "-t", "--threads", type=int, default=0, metavar="N", help="threads; 0: all cores, 1: bit-reproducible"
    )
    plugin_option(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="tracebacks and library warnings")


def say(text: object) -> None:
    """Print lines to stdout, with nothing in them that a terminal obeys."""
    print("\n".join(printable(line) for line in str(text).split("\n")))


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
    """Print a line on stderr."""
    print(f"fd_mitsuba: {printable(line)}", file=sys.stderr)


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
    """Start Mitsuba by the options."""
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
