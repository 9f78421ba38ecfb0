"""What the commands that take a scene have in common: its options, how it is loaded, the settings beside it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fd_mitsuba.cli.options import definitions, machine_options, quiet_libraries
from fd_mitsuba.errors import UserError

if TYPE_CHECKING:
    from fd_mitsuba.config import ChosenSettings, RunConfig
    from fd_mitsuba.scene.edit_scene import EditScene


def scene_options(parser: argparse.ArgumentParser) -> None:
    """The scene, -D, --prompt, --regions, and the machine's options."""
    parser.add_argument("scene", help="Mitsuba scene file (XML), or a mesh file, which is imported first")
    scene_changes(parser)


def scene_changes(parser: argparse.ArgumentParser) -> None:
    """All of `scene_options` but the scene itself, in which a mesh file's place is filled by `prepare_scene`."""
    parser.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scene"
    )
    parser.add_argument("--prompt", help="instead of the scene's prompt")
    parser.add_argument(
        "--regions", metavar="FILE", help="an XML file with focal regions, such as for a scene that was exported"
    )
    placing_options(parser)
    axis_options(parser)
    machine_options(parser)


def placing_options(parser: argparse.ArgumentParser) -> None:
    """--at, --size and --subtract."""
    parser.add_argument(
        "--at",
        action="append",
        default=[],
        metavar="PLACE",
        help="where a region goes: top, head, back, front, rear, 'left side', 'right side', bottom, 'front of the "
        "head', or x,y,z; may be given several times; default for a mesh file: where the prompted part usually is",
    )
    parser.add_argument(
        "--size",
        metavar="SIZE",
        help="of these regions: a share of the longest side such as 0.3 or 30%%, or 12u; default: as such parts are",
    )
    parser.add_argument(
        "--subtract", action="store_true", help="these regions take something off, in place of adding a part"
    )


def axis_options(parser: argparse.ArgumentParser) -> None:
    """--up and --front."""
    parser.add_argument("--up", metavar="AXIS", help="a mesh file's axis that points up, such as z; default: a guess")
    parser.add_argument("--front", metavar="AXIS", help="its axis to look along, such as -y; default: a guess")


def settings_options(parser: argparse.ArgumentParser) -> None:
    """-c and --set."""
    parser.add_argument(
        "-c",
        "--config",
        metavar="FILE|NAME",
        help="settings: a TOML file, or quick, paper, smoke; default: quick with the built-in prior, else paper",
    )
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one setting"
    )


def chosen_settings(options: argparse.Namespace) -> ChosenSettings:
    """The settings that the options ask for, and how they were chosen where the options do not say."""
    from fd_mitsuba.config import settings_for_run

    chosen = settings_for_run(options.config, options.overrides)
    plugins = tuple(dict.fromkeys([*chosen.config.plugins, *options.plugins]))
    return replace(chosen, config=chosen.config.model_copy(update={"plugins": plugins}))


def load(
    options: argparse.Namespace,
    on_misplaced: Callable[[UserError], None] | None = None,
    config: RunConfig | None = None,
    beside: Path | None = None,
    needs_region: bool = True,
) -> EditScene:
    """The scene, with Mitsuba started by the options; `on_misplaced` as in `api.load_scene`.

    Args:
        config: whose plugins are imported, besides those of the options.
        beside: the run folder; see `given_scene.prepare_scene`.
        needs_region: False: a scene without regions is taken, too.
    """
    parameters = definitions(options)
    quiet_libraries(options)
    plugins = options.plugins if config is None else config.plugins
    if options.prompt is not None and not options.prompt.strip():
        raise UserError("--prompt: is blank; describe the edited object")
    from fd_mitsuba.api import load_scene
    from fd_mitsuba.backend.threads import share_cores
    from fd_mitsuba.cli.given_scene import prepare_scene
    from fd_mitsuba.config.registry import load_plugins

    share_cores(options.threads, options.variant)
    load_plugins(plugins)
    prepare_scene(options, beside)
    return load_scene(
        options.scene,
        parameters,
        prompt=options.prompt,
        regions=options.regions,
        threads=options.threads,
        variant=options.variant,
        on_misplaced=on_misplaced,
        plugins=plugins,
        needs_region=needs_region,
    )
