"""The command `studio`."""

from __future__ import annotations

import argparse
import signal
import threading
from pathlib import Path

from fd_mitsuba.assets.readers import is_asset
from fd_mitsuba.cli.given_scene import prepare_scene, scene_label
from fd_mitsuba.cli.options import definitions, machine_options, remark, say, start
from fd_mitsuba.cli.scene_options import axis_options, placing_options, settings_options
from fd_mitsuba.errors import UserError


def add_studio_command(commands: argparse._SubParsersAction) -> None:
    """Put `studio` beside the other commands."""
    studio = commands.add_parser("studio", help="place regions and see parts grow, in a browser")
    studio.add_argument(
        "scene",
        metavar="SCENE|RUN",
        help="Mitsuba scene file (XML), a mesh file, a run folder, or a work folder of the studio",
    )
    studio.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scene"
    )
    studio.add_argument("--prompt", help="instead of the scene's prompt")
    studio.add_argument("--port", type=int, default=8080, help="default: 8080; 0: any that is free")
    studio.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen at; default: 127.0.0.1, this machine alone; for any other the URL has a token",
    )
    studio.add_argument("-o", "--output", metavar="FOLDER", help="work folder; default: runs/studio_<scene>")
    settings_options(studio)
    placing_options(studio)
    axis_options(studio)
    machine_options(studio)
    studio.set_defaults(call=_studio, regions=None)


def _studio(options: argparse.Namespace) -> int:
    from fd_mitsuba.studio.server import require_viser, serve

    require_viser()
    parameters = definitions(options)
    prompt = options.prompt
    from fd_mitsuba.studio.settings import PRESETS, StudioSettings

    preset = PRESETS[0] if options.config is None else str(options.config)
    overrides = [*options.overrides, *([f"plugins={options.plugins!r}"] if options.plugins else [])]
    settings = StudioSettings(preset, overrides=tuple(overrides))
    settings.config()
    start(options)
    from fd_mitsuba.studio.opening import open_target
    from fd_mitsuba.studio.session import Session

    output = None if options.output is None else Path(options.output)
    if is_asset(options.scene):
        output = output or Path("runs") / f"studio_{scene_label(options.scene)}"
    elif options.at:
        raise UserError("--at: in the studio, a scene's regions are placed by a click on the base")
    prepare_scene(options, output)
    opened = open_target(Path(options.scene), output, parameters, prompt, remark)
    session = Session(opened, settings, options.threads, options.variant, say=remark)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: ended.set())
    serve(session, options.host, options.port, say, ended)
    return 0
