"""The command `preview`."""

from __future__ import annotations

import argparse
from pathlib import Path

from fd_mitsuba.cli.given_scene import scene_label
from fd_mitsuba.cli.options import say
from fd_mitsuba.cli.scene_options import load, scene_options
from fd_mitsuba.errors import UserError


def add_preview_command(commands: argparse._SubParsersAction) -> None:
    """Put `preview` beside the other commands."""
    preview = commands.add_parser("preview", help="images of the base from all sides, with its focal regions")
    scene_options(preview)
    preview.add_argument("-o", "--output", metavar="FOLDER", help="default: runs/<scene>_preview")
    preview.set_defaults(call=_preview)


def _preview(options: argparse.Namespace) -> int:
    misplaced: list[UserError] = []
    name = scene_label(options.scene)
    if options.output and Path(options.output).suffix.lower() in (".png", ".jpg", ".jpeg"):
        raise UserError(f"-o {options.output}: names the folder of the images; give it without a suffix")
    scene = load(options, misplaced.append, needs_region=False)
    from fd_mitsuba.viewing.preview import preview_scene

    folder = Path(options.output) if options.output else Path("runs") / f"{name}_preview"
    for path in preview_scene(scene, folder):
        say(path)
    low, high = scene.base_box
    say("base " + ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True)))
    if misplaced:
        raise misplaced[0]
    return 0
