"""The command line: parse, call, print.

Exit codes: 0 done, 1 bad input, 2 usage, 130 interrupted by SIGINT or SIGTERM (a run within its steps writes a
checkpoint first).
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NoReturn

from fd_mitsuba import __version__
from fd_mitsuba.cli.ablate import add_ablate_commands
from fd_mitsuba.cli.batch import add_batch_commands
from fd_mitsuba.cli.evaluate import add_evaluate_commands
from fd_mitsuba.cli.export import add_export_commands
from fd_mitsuba.cli.options import definitions, machine_options, remark, start
from fd_mitsuba.cli.prior import add_prior_commands
from fd_mitsuba.cli.report import add_report_commands
from fd_mitsuba.errors import Interrupted, UserError


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code; user errors become one line on stderr."""
    own_process = arguments is None
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
    if own_process:
        _exit_on_signals(options)
    options.command_line = shlex.join(["fd_mitsuba", *arguments])
    verbose = getattr(options, "verbose", False)
    try:
        return options.call(options)
    except Interrupted as stop:
        print(f"fd_mitsuba: {stop}", file=sys.stderr)
        return 130
    except UserError as error:
        if verbose:
            raise
        print(f"fd_mitsuba: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(_interrupted(options), file=sys.stderr)
        return 130
    except OSError as error:
        if verbose:
            raise
        print(
            f"fd_mitsuba: error: {error.filename or 'output'}: {error.strerror or error}; free space or check the path",
            file=sys.stderr,
        )
        return 1


def _exit_on_signals(options: argparse.Namespace) -> None:
    """From here on SIGINT and SIGTERM end the process in one line; within a run's steps the loop has its own way.

    The process ends in the handler: an exception raised from there while a library is being imported, or in a callback
    of native code, ends in a traceback or an abort instead. Files are written so that this does no harm.
    """

    def end(number: int, frame: FrameType | None) -> None:
        os.write(2, f"{_interrupted(options)}\n".encode())
        os._exit(130)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)


def _interrupted(options: argparse.Namespace) -> str:
    return "fd_mitsuba: interrupted" + ("; continue with --resume" if options.call is _run else "")


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage text before it."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="fd_mitsuba", description="Text-driven, part-wise 3D editing on Mitsuba 3.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="grow the part that the scene asks for")
    _scene_options(run)
    run.add_argument("-c", "--config", metavar="FILE", help="settings (TOML); default: the paper's")
    run.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one setting"
    )
    run.add_argument("-o", "--output", metavar="FOLDER", help="run folder; default: runs/<scene>")
    run.add_argument(
        "--stage", choices=("all", "geometry", "appearance"), default="all", help="default: all, one after the other"
    )
    run.add_argument(
        "--from", dest="geometry_from", metavar="RUN", help="take the finished geometry of another run of this scene"
    )
    run.add_argument("--resume", action="store_true", help="go on with an interrupted run in the output folder")
    run.add_argument("-q", "--quiet", action="store_true", help="no progress display")
    run.set_defaults(call=_run)

    check = commands.add_parser("check", help="examine a scene before a run")
    _scene_options(check)
    check.add_argument("-c", "--config", metavar="FILE")
    check.add_argument("--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE")
    check.add_argument("--json", action="store_true", help="machine-readable")
    check.set_defaults(call=_check)

    preview = commands.add_parser("preview", help="pictures of the base with the focal regions drawn in")
    _scene_options(preview)
    preview.add_argument("-o", "--output", metavar="FOLDER", help="default: runs/<scene>_preview")
    preview.set_defaults(call=_preview)

    add_export_commands(commands)
    add_batch_commands(commands)
    add_report_commands(commands)
    add_evaluate_commands(commands)
    add_ablate_commands(commands)

    doctor = commands.add_parser("doctor", help="what this machine offers: LLVM, Mitsuba, torch, the built-in prior")
    doctor.add_argument("--json", action="store_true")
    doctor.set_defaults(call=_doctor)

    add_prior_commands(commands)
    return parser


def _scene_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", help="Mitsuba scene file (XML)")
    parser.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scene"
    )
    parser.add_argument("--prompt", help="instead of the scene's prompt")
    parser.add_argument(
        "--regions", metavar="FILE", help="an XML file with focal regions, such as for a scene that was exported"
    )
    machine_options(parser)


def _run(options: argparse.Namespace) -> int:
    from fd_mitsuba.config import load_config

    config = load_config(options.config, options.overrides)
    scene = _load(options)
    from fd_mitsuba.evaluation.report.run_page import reported
    from fd_mitsuba.runs.pipeline import STAGES, run

    folder = Path(options.output) if options.output else Path("runs") / Path(options.scene).resolve().parent.name
    with reported(folder, remark):
        metrics = run(
            scene,
            config,
            folder,
            resume=options.resume,
            command=options.command_line,
            quiet=options.quiet,
            say=remark,
            stages=STAGES if options.stage == "all" else (options.stage,),
            geometry_from=Path(options.geometry_from) if options.geometry_from else None,
        )
    lit = "appearance" in metrics
    print(
        f"{folder}: part in export/, pictures in images/{'appearance' if lit else 'turntable'}.png, all in report.html"
    )
    print(
        f"inside the region {metrics['inside_fraction']:.1%}, overlap with the base {metrics['overlap_fraction']:.1%}, "
        f"base identical: {metrics['base_identical']}, {metrics['seconds']:.0f} s"
    )
    return 0


def _check(options: argparse.Namespace) -> int:
    from fd_mitsuba.config import load_config

    config = load_config(options.config, options.overrides)
    scene = _load(options)
    from fd_mitsuba.runs.check import check_scene

    report = check_scene(scene, config)
    print(json.dumps(report.to_json(), indent=2) if options.json else "\n".join(report.lines()))
    return 0


def _preview(options: argparse.Namespace) -> int:
    misplaced: list[UserError] = []
    scene = _load(options, misplaced.append)
    from fd_mitsuba.viewing.preview import preview_scene

    name = Path(options.scene).resolve().parent.name
    folder = Path(options.output) if options.output else Path("runs") / f"{name}_preview"
    for path in preview_scene(scene, folder):
        print(path)
    if misplaced:
        raise misplaced[0]
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from fd_mitsuba.runs.doctor import examine

    findings = examine()
    if options.json:
        print(json.dumps({finding.name: {"ok": finding.ok, "found": finding.text} for finding in findings}, indent=2))
    else:
        for finding in findings:
            print(f"{'ok ' if finding.ok else 'BAD'} {finding.name}: {finding.text}")
    return 0 if all(finding.ok for finding in findings) else 1


def _load(options: argparse.Namespace, on_misplaced: Callable[[UserError], None] | None = None):
    """The scene, with Mitsuba started as the options say; `on_misplaced` as in `load_edit_scene`."""
    parameters = definitions(options)
    prompt = None if options.prompt is None else " ".join(options.prompt.split())
    if prompt == "":
        raise UserError("--prompt: is blank; say what the edited object shall look like")
    start(options)
    from fd_mitsuba.scene.edit_scene import load_edit_scene

    return load_edit_scene(options.scene, parameters, options.regions, prompt, on_misplaced)
