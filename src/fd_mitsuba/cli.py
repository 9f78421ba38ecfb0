"""The command line: parse, call, print.

Exit codes: 0 done, 1 bad input, 2 usage, 130 interrupted (a run within its steps writes a checkpoint first).
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import warnings
from pathlib import Path
from typing import NoReturn

from fd_mitsuba import __version__
from fd_mitsuba.config import load_config
from fd_mitsuba.errors import Interrupted, UserError

DEFAULT_VARIANT = "llvm_ad_rgb"


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code; user errors become one line on stderr."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(arguments)
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
        remedy = "; continue with --resume" if options.call is _run else ""
        print(f"fd_mitsuba: interrupted{remedy}", file=sys.stderr)
        return 130
    except OSError as error:
        if verbose:
            raise
        print(
            f"fd_mitsuba: error: {error.filename or 'output'}: {error.strerror or error}; free space or check the path",
            file=sys.stderr,
        )
        return 1


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
    run.add_argument("--prompt", help="instead of the scene's prompt")
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

    doctor = commands.add_parser("doctor", help="what this machine offers: LLVM, Mitsuba, torch, the built-in prior")
    doctor.add_argument("--json", action="store_true")
    doctor.set_defaults(call=_doctor)

    prior = commands.add_parser("prior", help="the words that the built-in prior knows; train and pack a new one")
    prior.add_argument("--json", action="store_true")
    prior.set_defaults(call=_prior)
    actions = prior.add_subparsers(dest="action", metavar="ACTION")
    train = actions.add_parser("train", help="train on fresh pictures; goes on where the folder's checkpoint ends")
    train.add_argument("-o", "--output", default="runs/prior", metavar="FOLDER", help="checkpoint and log")
    train.add_argument("--steps", type=int, default=4000, help="length of the schedule")
    train.add_argument("--hours", type=float, default=8.0, help="stop after this time at the latest")
    train.add_argument(
        "--init", metavar="FOLDER", help="start from a packed prior instead of random weights"
    )
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("-t", "--threads", type=int, default=0, metavar="N")
    train.set_defaults(call=_prior_train)
    pack = actions.add_parser("pack", help="write a checkpoint as a pipeline folder")
    pack.add_argument("checkpoint", help="checkpoint.pt of a training")
    pack.add_argument("-o", "--output", required=True, metavar="FOLDER")
    pack.set_defaults(call=_prior_pack)
    return parser


def _scene_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", help="Mitsuba scene file (XML)")
    parser.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scene"
    )
    parser.add_argument("-m", "--variant", default=DEFAULT_VARIANT, help="Mitsuba variant")
    parser.add_argument(
        "-t", "--threads", type=int, default=0, metavar="N", help="threads; 0: all cores, 1: bit-reproducible"
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="tracebacks and library warnings")


def _run(options: argparse.Namespace) -> int:
    from dataclasses import replace

    config = load_config(options.config, options.overrides)
    prompt = None if options.prompt is None else " ".join(options.prompt.split())
    if prompt == "":
        raise UserError("--prompt: is blank; say what the edited object shall look like")
    scene = _load(options)
    if prompt is not None:
        scene = replace(scene, prompt=prompt)
    from fd_mitsuba.pipeline import run

    folder = Path(options.output) if options.output else Path("runs") / Path(options.scene).resolve().parent.name
    metrics = run(scene, config, folder, options.resume, options.command_line, options.quiet, _remark)
    print(f"{folder}: part in export/, pictures in images/turntable.png and videos/turntable.mp4")
    print(
        f"inside the region {metrics['inside_fraction']:.1%}, overlap with the base {metrics['overlap_fraction']:.1%}, "
        f"base identical: {metrics['base_identical']}, {metrics['seconds']:.0f} s"
    )
    return 0


def _check(options: argparse.Namespace) -> int:
    config = load_config(options.config, options.overrides)
    scene = _load(options)
    from fd_mitsuba.check import check_scene

    report = check_scene(scene, config)
    print(json.dumps(report.to_json(), indent=2) if options.json else "\n".join(report.lines()))
    return 0


def _preview(options: argparse.Namespace) -> int:
    scene = _load(options)
    from fd_mitsuba.preview import preview_scene

    name = Path(options.scene).resolve().parent.name
    folder = Path(options.output) if options.output else Path("runs") / f"{name}_preview"
    for path in preview_scene(scene, folder):
        print(path)
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from fd_mitsuba.doctor import examine

    findings = examine()
    if options.json:
        print(json.dumps({finding.name: {"ok": finding.ok, "found": finding.text} for finding in findings}, indent=2))
    else:
        for finding in findings:
            print(f"{'ok ' if finding.ok else 'BAD'} {finding.name}: {finding.text}")
    return 0 if all(finding.ok for finding in findings) else 1


def _prior(options: argparse.Namespace) -> int:
    from fd_mitsuba.prior.captions import ADJECTIVES, BODY_WORDS, PART_WORDS

    words = {
        "bodies": {name: list(synonyms) for name, synonyms in BODY_WORDS.items()},
        "parts": {name: list(synonyms) for name, synonyms in PART_WORDS.items()},
        "adjectives": sorted(set(ADJECTIVES) - {""}),
    }
    if options.json:
        print(json.dumps(words, indent=2))
        return 0
    for group in ("bodies", "parts"):
        print(f"{group}:")
        for synonyms in words[group].values():
            print(f"  {', '.join(synonyms)}")
    print(f"adjectives: {', '.join(words['adjectives'])}")
    print('a prompt is a sentence such as "a horse with two wings"; for anything else set guidance.model to the')
    print("folder or hub id of a Stable Diffusion model")
    return 0


def _remark(line: str) -> None:
    print(f"fd_mitsuba: {line}", file=sys.stderr)


def _prior_train(options: argparse.Namespace) -> int:
    from fd_mitsuba.threads import network_threads, share_cores

    share_cores(options.threads)
    from fd_mitsuba.prior.train import train

    init = Path(options.init) if options.init else None
    if init is not None and not (init / "model_index.json").is_file():
        raise UserError(f"{init}: not a packed prior; make one with fd_mitsuba prior pack")
    with network_threads():
        train(Path(options.output), options.hours * 3600, total_steps=options.steps, seed=options.seed, init=init)
    print(f"{options.output}: checkpoint.pt and log.jsonl")
    return 0


def _prior_pack(options: argparse.Namespace) -> int:
    from fd_mitsuba.prior.pack import pack

    if not Path(options.checkpoint).is_file():
        raise UserError(f"{options.checkpoint}: no such checkpoint; make one with fd_mitsuba prior train")
    pack(Path(options.checkpoint), Path(options.output))
    print(options.output)
    return 0


def _load(options: argparse.Namespace):
    """The scene, with Mitsuba started as the options say."""
    parameters = {}
    for item in options.definitions:
        name, separator, value = item.partition("=")
        if not separator or not name:
            raise UserError(f"-D {item}: write -D name=value")
        parameters[name] = value
    if options.threads < 0:
        raise UserError(f"-t {options.threads}: give 0 (all cores) or a positive number")
    if not options.verbose:
        warnings.filterwarnings("ignore")
        os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")
        os.environ.setdefault("DIFFUSERS_VERBOSITY", "error")
    from fd_mitsuba.threads import share_cores

    share_cores(options.threads, options.variant)
    from fd_mitsuba.scene.edit_scene import load_edit_scene

    return load_edit_scene(options.scene, parameters)
