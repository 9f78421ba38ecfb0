"""The commands for a run's result: `export`, `parts`, `render`, `instance`."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from fd_mitsuba.cli.options import definitions, machine_options, remark, say, start
from fd_mitsuba.errors import UserError


def add_export_commands(commands: argparse._SubParsersAction) -> None:
    """Put them beside the other commands."""
    export = commands.add_parser("export", help="write a run's result for other programs")
    export.add_argument("run", metavar="RUN", help="run folder, finished or interrupted")
    export.add_argument(
        "--format",
        dest="formats",
        nargs="+",
        default=["glb", "obj", "ply", "mitsuba"],
        metavar="FORMAT",
        help="any of glb obj ply mitsuba (default: those four), print, usdz, or what a plugin registers",
    )
    export.add_argument(
        "--faces",
        nargs="+",
        metavar="N[,N]",
        help="at most so many triangles a part; of several, one asset a level of detail; default: the run's",
    )
    export.add_argument("--texture-size", type=int, default=1024, metavar="N", help="texels a side; default: 1024")
    machine_options(export)
    export.add_argument("--json", action="store_true", help="machine-readable")
    export.set_defaults(call=_export)

    render = commands.add_parser("render", help="a lit turntable of a run, under its own light or another")
    render.add_argument("run", metavar="RUN", help="run folder whose appearance stage has begun")
    render.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scene anew"
    )
    render.add_argument("-o", "--output", metavar="NAME", help="name of the images in RUN/renders; default: render")
    render.add_argument(
        "--sensor",
        metavar="ID",
        help="instead: the exported scene as that sensor of its own shows it",
    )
    render.add_argument("--views", type=int, metavar="N", help="images around the object; default: 8")
    render.add_argument("--size", type=int, metavar="N", help="pixels a side; default: 256")
    render.add_argument("--spp", type=int, default=128, metavar="N", help="samples a pixel; default: 128")
    render.add_argument("--depth", type=int, default=3, metavar="N", help="Mitsuba's max_depth; default: 3")
    machine_options(render)
    render.set_defaults(call=_render)

    instance = commands.add_parser(
        "instance", help="a Mitsuba scene and a GLB that show an exported part in many places"
    )
    instance.add_argument("run", metavar="RUN", help="run folder of which the format mitsuba was exported")
    instance.add_argument("--transforms", required=True, metavar="FILE", help="JSON list of placements")
    instance.add_argument("-o", "--output", metavar="NAME", help="the scene's file name; default: instances.xml")
    instance.add_argument("-v", "--verbose", action="store_true", help="tracebacks")
    instance.set_defaults(call=_instance)

    parts = commands.add_parser("parts", help="the parts of an exported object, of all rounds: list, hide, remove")
    parts.add_argument("run", metavar="RUN", help="run folder of which the format mitsuba was exported")
    for name, text in (
        ("hide", "leave a part out of the exports, made anew"),
        ("show", "take a hidden part in again"),
        ("remove", "as hide, and its exported files go"),
    ):
        parts.add_argument(f"--{name}", action="append", default=[], metavar="NAME", help=text)
    machine_options(parts)
    parts.add_argument("--json", action="store_true", help="machine-readable")
    parts.set_defaults(call=_parts)


def _parts(options: argparse.Namespace) -> int:
    start(options)
    from fd_mitsuba.runs.parts import change_parts, list_parts

    run, changes = Path(options.run), (options.hide, options.show, options.remove)
    found = change_parts(run, *changes, remark) if any(changes) else list_parts(run)
    if options.json:
        print(json.dumps([asdict(part) for part in found], indent=2))
        return 0
    for part in found:
        hidden = "" if part.state == "shown" else f", {part.state}"
        place = run / "export" / "mitsuba" / part.file
        say(f"{part.name}: round {part.round}, {part.prompt!r}, {part.faces} faces, {place}{hidden}")
    return 0


def _render(options: argparse.Namespace) -> int:
    start(options)
    from fd_mitsuba.runs.appearance_outcome import render_run
    from fd_mitsuba.runs.sensor_image import render_by_sensor

    run, name, changed = Path(options.run), options.output or "render", definitions(options)
    if options.sensor is not None:
        if options.views is not None or options.size is not None:
            raise UserError("--sensor: renders one image of its film's size; leave out --views and --size")
        paths = render_by_sensor(run, options.sensor, name, options.spp, options.depth, changed)
    else:
        views, size = (usual if given is None else given for given, usual in ((options.views, 8), (options.size, 256)))
        settings = (views, size, options.spp, options.depth)
        paths = render_run(run, changed, name, *settings, remark)
    for path in paths:
        say(path)
    return 0


def _export(options: argparse.Namespace) -> int:
    start(options)
    from fd_mitsuba.config.toml_reading import read_choice
    from fd_mitsuba.runs.levels import read_levels
    from fd_mitsuba.runs.pipeline import export_run

    formats = [read_choice(item) for item in options.formats]
    faces = None if options.faces is None else read_levels(options.faces)
    written = export_run(Path(options.run), formats, options.texture_size, remark, faces)
    if options.json:
        print(json.dumps(written, indent=2))
        return 0
    for name in written["files"]:
        say(Path(options.run) / "export" / name)
    for material, notes in written["notes"].items():
        remark(f"material {material}: {'; '.join(notes)}")
    return 0


def _instance(options: argparse.Namespace) -> int:
    from fd_mitsuba.export.instances import write_instances

    for path in write_instances(Path(options.run), Path(options.transforms), options.output or "instances.xml"):
        say(path)
    return 0
