"""The parts of a run's exported object, of this round and of earlier ones: listed, hidden, shown again, removed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.formats import EXPORTERS
from fd_mitsuba.export.mitsuba_xml import FILES
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.runs.pipeline import export_run
from fd_mitsuba.runs.run_lock import run_lock
from fd_mitsuba.scene.part_stack import HIDDEN, RECORD_NAME, REMOVED, SHOWN, StackedPart, read_stack, stack_bytes

_BAKED = ("base_color", "orm", "roughness", "metallic", "alpha", "normal", "normal_mitsuba")
"""Pictures that a part may have, whether its Mitsuba scene reads them or not."""


def list_parts(run: Path) -> tuple[StackedPart, ...]:
    """The parts in the run's exported scene, oldest first; removed ones are not among them.

    Raises:
        UserError: no such run, or the format `mitsuba` was not exported.
    """
    return tuple(part for part in _stack(run)[0] if part.state != REMOVED)


def change_parts(
    run: Path,
    hide: Sequence[str] = (),
    show: Sequence[str] = (),
    remove: Sequence[str] = (),
    say: Callable[[str], None] = print,
) -> tuple[StackedPart, ...]:
    """Leave parts out of the run's exports or take them in again, and export anew what had been; returns the parts.

    A hidden part's files stay, a removed one's go. The run's own state, its checkpoints and `export/part_<name>.ply`,
    is not touched.

    Raises:
        UserError: an unknown name, or one that is given twice; the last part shown; see `export_run`.
    """
    _stack(run)  # where there is no such run, no folder is to be made
    with run_lock(run, say):
        return _change_parts(run, hide, show, remove, say)


def _change_parts(
    run: Path, hide: Sequence[str], show: Sequence[str], remove: Sequence[str], say: Callable[[str], None]
) -> tuple[StackedPart, ...]:
    stack, settings = _stack(run)
    names = [*hide, *show, *remove]
    known = [part.name for part in stack if part.state != REMOVED]
    for name in names:
        if name not in known:
            raise UserError(f"{run}: has no part {name!r}; its parts: {', '.join(known) or 'none'}")
        if names.count(name) > 1:
            raise UserError(f"part {name!r} is named twice; hide, show or remove it")
    wanted = dict.fromkeys(hide, HIDDEN) | dict.fromkeys(show, SHOWN) | dict.fromkeys(remove, REMOVED)
    changed = [replace(part, state=wanted.get(part.name, part.state)) for part in stack]
    if not any(part.state == SHOWN for part in changed):
        raise UserError(f"{run}: {names[0]!r} is the last part; show another one first, or use the base itself")
    folder = run / "export"
    formats = [name for name in EXPORTERS.names() if (folder / EXPORTERS.entry(name, "format").make.leaves).exists()]
    record = folder / "mitsuba" / RECORD_NAME
    before = record.read_bytes()
    write_atomically(record, stack_bytes(changed, settings))
    try:
        first = settings.get("faces")
        faces = None if first is None else [first, *settings.get("levels", [])]
        export_run(run, formats, settings.get("texture_size", 1024), say, faces)
    except BaseException:
        write_atomically(record, before)
        raise
    latest = max(part.round for part in changed)
    left = {file for part in changed if part.state != REMOVED for file in _files(part)}
    left |= {name for part in changed for name in _files(part) if f"{FILES}/{name}" in _text(folder)}
    for part in changed:
        if part.state == REMOVED:
            _delete(folder, part, left, in_base=part.round < latest)
    return list_parts(run)


def _stack(run: Path) -> tuple[tuple[StackedPart, ...], dict[str, Any]]:
    if not run.is_dir():
        raise UserError(f"{run}: no such run folder; give the -o folder of a run")
    folder = run / "export" / "mitsuba"
    stack, settings = read_stack(folder)
    if not (folder / RECORD_NAME).is_file():
        raise UserError(f"{run}: its parts were not exported yet; run fd_mitsuba export {run} --format glb mitsuba")
    return stack, settings


def _files(part: StackedPart) -> set[str]:
    return {Path(name).name for name in (part.file, part.normal, *part.pictures) if name}


def _text(folder: Path) -> str:
    return (folder / "mitsuba" / "scene.xml").read_text(encoding="utf-8")


def _delete(folder: Path, part: StackedPart, left: set[str], in_base: bool) -> None:
    """Delete an exported part's files, except for those in `left`, which something else uses.

    Args:
        in_base: it is of an earlier round, so that it has been copied with the base.
    """
    (folder / "ply" / f"{part.shape}.ply").unlink(missing_ok=True)
    baked = {f"{part.shape}_{key}.png" for key in _BAKED}
    for name in (_files(part) | baked) - left:
        for place in (f"mitsuba/{FILES}", "textures", "obj", *(["base"] if in_base else [])):
            (folder / place / name).unlink(missing_ok=True)
        (folder / "textures" / name).with_suffix(".exr").unlink(missing_ok=True)
