"""The command `import`: a scene to edit out of a mesh file of any kind."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from fd_mitsuba.cli.options import say
from fd_mitsuba.cli.scene_options import axis_options, placing_options


def add_import_command(commands: argparse._SubParsersAction) -> None:
    """Put `import` beside the other commands."""
    parser = commands.add_parser("import", help="make a scene to edit out of a GLB, OBJ, DAE, 3DS, PLY, STL or OFF")
    parser.add_argument(
        "asset", help="mesh file: .glb .gltf .obj .dae .3ds .ply .stl .off, or a .zip of one with its images"
    )
    parser.add_argument("-o", "--output", metavar="FOLDER", help="the scene's folder; default: scenes/<asset>")
    parser.add_argument("--prompt", help="what the edited object should look like")
    parser.add_argument("--base-prompt", help="what it looks like now; default: the prompt up to its `with`")
    placing_options(parser)
    axis_options(parser)
    parser.add_argument("--units", metavar="UNIT", choices=("mm", "cm", "m"), help="its unit: mm, cm or m")
    parser.add_argument("--light", metavar="FILE", help="an EXR environment map; default: a shipped one")
    parser.add_argument("-v", "--verbose", action="store_true", help="tracebacks")
    parser.set_defaults(call=_import)


def _import(options: argparse.Namespace) -> int:
    from fd_mitsuba.api import import_asset

    path = Path(options.asset)
    folder = Path(options.output) if options.output else Path("scenes") / path.stem
    imported = import_asset(
        path,
        folder,
        prompt=options.prompt,
        base_prompt=options.base_prompt,
        up=options.up,
        front=options.front,
        units=options.units,
        at=options.at,
        size=options.size,
        light=options.light,
        subtract=options.subtract,
    )
    for line in imported.lines():
        say(line)
    if imported.refusal is not None:
        return 0
    wanted = "" if options.prompt else ' --prompt "..."'
    say(f"next     fd_mitsuba run {shlex.quote(str(imported.scene))}{wanted} -o runs/{shlex.quote(path.stem)}")
    return 0
