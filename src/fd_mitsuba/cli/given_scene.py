"""What stands behind the scene argument of a command: a scene file, or a mesh file that is imported on the way."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from pathlib import Path

from fd_mitsuba.assets.readers import is_asset
from fd_mitsuba.cli.options import definitions, remark
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object, write_json

_RECORD = "import.json"


def scene_label(scene: str) -> str:
    """What a scene is called in names of folders: that of its own folder, or of a mesh file."""
    path = Path(scene)
    return path.stem if is_asset(scene) else path.resolve().parent.name


def prepare_scene(options: argparse.Namespace, beside: Path | None, say: Callable[[str], None] = remark) -> None:
    """Import a mesh file and put the regions of `--at`, so that `options.scene` and `options.regions` are files.

    Args:
        options: of a command with `scene_changes`; changed in place.
        beside: the run folder, beside which what is made stays: `<run>.scene` and `<run>.regions.xml`; None: it is
            needed by this command alone, and goes when the process ends.
        say: takes a line about what was made.

    Raises:
        UserError: options that do not fit each other, an asset or a scene that cannot be read.
    """
    if is_asset(options.scene):
        options.scene = str(_imported(options, beside, say))
        return
    for name in ("up", "front"):
        if getattr(options, name) is not None:
            raise UserError(f"--{name}: is for mesh files; a scene's to_world turns its shapes")
    if not options.at:
        for name in ("size", "subtract"):
            if getattr(options, name) not in (None, False):
                raise UserError(f"--{name}: is for the regions of --at; say where they go, too")
        return
    if options.regions is not None:
        raise UserError("--at and --regions: give one of the two")
    from fd_mitsuba.api import temporary_folder
    from fd_mitsuba.assets.placing import write_placed_regions
    from fd_mitsuba.guidance.prompted_part import prompted_parts
    from fd_mitsuba.scene.load_scene import scene_prompt

    folder = temporary_folder() if beside is None else beside.parent
    target = folder / ("regions.xml" if beside is None else f"{beside.name}.regions.xml")
    told = definitions(options)
    # A scene without any prompt says so when it is loaded.
    told_prompt = options.prompt or scene_prompt(Path(options.scene), told)
    wanted = prompted_parts(told_prompt, removed=options.subtract)
    how = options.at, options.size, target, options.subtract, wanted
    about = write_placed_regions(Path(options.scene), told, *how)
    for line in about:
        say(f"region {line}; in place of the scene's own")
    options.regions = str(target)


def _imported(options: argparse.Namespace, beside: Path | None, say: Callable[[str], None]) -> Path:
    from fd_mitsuba.api import import_asset, temporary_folder
    from fd_mitsuba.runs.run_folder import TRIES_RECORD

    asset = Path(options.scene)
    if options.regions is not None and options.at:
        raise UserError("--at and --regions: give one of the two")
    wanted = {
        "prompt": options.prompt,
        "up": options.up,
        "front": options.front,
        "at": list(options.at),
        "size": options.size,
    }
    if options.subtract:  # not in records of earlier versions
        wanted["subtract"] = True
    folder = temporary_folder() / asset.stem if beside is None else beside.with_name(f"{beside.name}.scene")
    record = {"asset": asset.name, "options": wanted, "bytes": _bytes(asset)}
    before = read_json_object(folder / _RECORD)
    if before is not None and {key: before.get(key) for key in record} == json.loads(json.dumps(record)):
        return folder / "scene.xml"
    if beside is not None and any((beside / name).is_file() for name in ("run.json", TRIES_RECORD)):
        raise UserError(
            f"{beside}: holds a run already, of another import or another prompt; choose another -o folder, or give "
            "the options of that run"
        )
    if before is not None and set(before.get("files") or []) >= {path.name for path in folder.iterdir()}:
        shutil.rmtree(folder)  # made by an import of something else, and by nobody else
    imported = import_asset(asset, folder, **wanted)
    write_json(folder / _RECORD, record | {"files": sorted({path.name for path in folder.iterdir()} | {_RECORD})})
    kept = "" if beside is None else f" imported to {imported.scene}"
    told = [*imported.regions, *imported.remarks, *imported.notes]
    if options.regions is not None:  # in their place
        told = [line for line in told if line not in imported.regions and not line.startswith("puts ")]
    say("; ".join([f"{asset}:{kept or ' imported'}", *told]))
    return imported.scene


def _bytes(asset: Path) -> int:
    try:
        return asset.stat().st_size
    except OSError:
        return -1
