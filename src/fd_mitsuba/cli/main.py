"""The command line: parse, call, print.

Exit codes: 0 done, 1 bad input, 2 usage, 130 interrupted by SIGINT or SIGTERM (a run within its steps writes a
checkpoint first).
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shlex
import signal
import sys
from types import FrameType
from typing import NoReturn

from fd_mitsuba import __version__
from fd_mitsuba.backend.processes import leave_the_word_to_the_first, speaks_first
from fd_mitsuba.cli.ablate import add_ablate_commands
from fd_mitsuba.cli.batch import add_batch_commands
from fd_mitsuba.cli.check import add_check_command
from fd_mitsuba.cli.compare import add_compare_command
from fd_mitsuba.cli.completion import add_completion_option
from fd_mitsuba.cli.demo import add_demo_command
from fd_mitsuba.cli.doctor import add_doctor_command
from fd_mitsuba.cli.evaluate import add_evaluate_commands
from fd_mitsuba.cli.export import add_export_commands
from fd_mitsuba.cli.import_asset import add_import_command
from fd_mitsuba.cli.names import add_names_command
from fd_mitsuba.cli.options import remark
from fd_mitsuba.cli.preview import add_preview_command
from fd_mitsuba.cli.prior import add_prior_commands
from fd_mitsuba.cli.report import add_report_commands
from fd_mitsuba.cli.run import add_run_command
from fd_mitsuba.cli.studio import add_studio_command
from fd_mitsuba.errors import Interrupted, UserError, out_of_memory, printable
from fd_mitsuba.io.safe_text import is_text

_LONGEST_USAGE = 300
_MAY_BE_NEGATIVE = ("--at", "--up", "--front")
_NEGATIVE = re.compile(r"-[xyzXYZ]|-\.?\d.*")


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code; user errors become one line on stderr."""
    own_process = arguments is None
    arguments = sys.argv[1:] if arguments is None else arguments
    if own_process:
        _open_standard_streams()
    options = command_parser().parse_args(_with_values_joined(arguments))
    if own_process:
        _exit_on_signals(options)
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):  # a name that the terminal's encoding does not have ends nothing
                stream.reconfigure(errors="backslashreplace")
    options.command_line = shlex.join(["fd_mitsuba", *arguments])
    verbose = getattr(options, "verbose", False)
    try:
        _require_text(arguments)
        code = options.call(options)
        if own_process and getattr(options, "writes_nothing", False):
            _leave(code)
        return code
    except Interrupted as stop:
        if speaks_first():
            remark(str(stop))
        return 130
    except UserError as error:
        if verbose:
            raise
        leave_the_word_to_the_first()
        remark(f"error: {error}")
        return 1
    except (MemoryError, RuntimeError) as error:
        failure = out_of_memory(error)
        if verbose or failure is None:
            raise
        remark(f"error: {failure}")
        return 1
    except KeyboardInterrupt:
        print(_interrupted(options), file=sys.stderr)
        return 130
    except BrokenPipeError:  # whoever read the output has gone, as `head` does: nobody is left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if verbose:
            raise
        remark(f"error: {error.filename or 'output'}: {error.strerror or error}; free space or check the path")
        return 1


def _with_values_joined(arguments: list[str]) -> list[str]:
    """The arguments with `--front -y` and `--at -1,0,2` as `--front=-y`: argparse would take the values for options."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in _MAY_BE_NEGATIVE and _NEGATIVE.fullmatch(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _leave(code: int) -> None:
    """End the process at once: taking torch and Mitsuba down in order takes half a second, and nothing waits for it."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as it is for a process that was started with it closed
            stream.flush()
    os._exit(code)


def _open_standard_streams() -> None:
    """What was started without one of the three streams must not take the next file that it opens for it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def _require_text(arguments: list[str]) -> None:
    """UserError for an argument that holds bytes which are no text: Mitsuba takes no such file names."""
    for argument, before in zip(arguments, ["", *arguments], strict=False):
        if not is_text(argument):
            option = f"{before} " if before.startswith("-") else ""
            raise UserError(
                f"{option}{ascii(argument)}: is not UTF-8 text; write it so, rename the file or folder, or set a UTF-8 "
                "locale, as by LC_ALL=C.UTF-8"
            )


def _exit_on_signals(options: argparse.Namespace) -> None:
    """From here on SIGINT and SIGTERM end the process in one line; within a run's steps the loop has its own way.

    The process ends in the handler: an exception raised from there while a library is being imported, or in a callback
    of native code, ends in a traceback or an abort instead. Files are written so that this does no harm.
    """

    def end(number: int, frame: FrameType | None) -> None:
        if speaks_first():
            os.write(2, f"{_interrupted(options)}\n".encode())
        os._exit(130)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)


def _interrupted(options: argparse.Namespace) -> str:
    return "fd_mitsuba: interrupted" + ("; continue with --resume" if getattr(options, "resumable", False) else "")


class _Parser(argparse.ArgumentParser):
    """Prints what is wrong in one line, without the usage text before it."""

    def error(self, message: str) -> NoReturn:
        words = printable(" ".join(message.split()))
        words = words if len(words) <= _LONGEST_USAGE else f"{words[:_LONGEST_USAGE]}..."
        self.exit(2, f"{self.prog}: error: {words}; see {self.prog} --help\n")


def command_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line, which the command reference is made from, too."""
    parser = _Parser(prog="fd_mitsuba", description="Text-driven, part-wise 3D editing on Mitsuba 3.")
    parser.add_argument("--version", action="version", version=__version__)
    add_completion_option(parser)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in (
        add_demo_command,
        add_import_command,
        add_run_command,
        add_check_command,
        add_preview_command,
        add_studio_command,
        add_export_commands,
        add_batch_commands,
        add_report_commands,
        add_evaluate_commands,
        add_ablate_commands,
        add_compare_command,
        add_names_command,
        add_doctor_command,
        add_prior_commands,
    ):
        add(commands)
    return parser
