"""What a run folder is a run of: its scene and its settings, read back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import json_fault, read_json_object
from fd_mitsuba.runs.run_folder import identity
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene


class _Copies(BaseModel):
    """Where in the run folder the scene's copy is."""

    scene: str
    regions: str | None = None


class _Identity(BaseModel):
    """What `run.json` says of the scene; the rest of it is not needed here."""

    model_config = ConfigDict(strict=True)
    scene: str
    scene_hash: str
    prompt: str
    parameters: dict[str, str]
    regions: str | None = None
    copy_: _Copies | None = None


def saved_run(
    folder: Path, changed: dict[str, str] | None = None, say: Callable[[str], None] = print
) -> tuple[EditScene, RunConfig]:
    """The scene and the settings of a run.

    The scene is read from where it lay when the run was started, if it is still there as it was. Otherwise the run's
    own copy of it is read, and `say` hears that.

    Args:
        changed: other values for some of the scene's `$name`, as for another light; the scene's files may then differ.

    Raises:
        UserError: no run there, settings of another version, a scene that is gone or was changed like its copy.
    """
    known, config = _identity(folder), _settings(folder)
    try:
        return _original(folder, known, config, changed), config
    except _Unusable as problem:
        place = folder / (known.copy_.scene if known.copy_ is not None else "scene/scene.xml")
        if known.copy_ is None or not place.is_file():
            raise UserError(f"{problem}, and {folder} has no copy of it; put it back") from None
        scene = _copy(folder, known, config, known.copy_, changed)
        say(f"{problem}; taking the copy of it in {place.parent}")
        return scene, config


class _Unusable(Exception):
    """Why the scene is not what the run has read."""


def _original(folder: Path, known: _Identity, config: RunConfig, changed: dict[str, str] | None) -> EditScene:
    path = _place(folder, known.scene)
    regions = None if known.regions is None else _place(folder, known.regions)
    for file in filter(None, (path, regions)):
        if not file.is_file():
            raise _Unusable(f"{file}: the run's scene is gone")
    own = known.copy_ and folder / known.copy_.scene
    if changed and own and own.is_file() and own.read_bytes() != path.read_bytes():
        raise _Unusable(f"{path}: was changed since the run")
    try:
        scene = load_edit_scene(path, {**known.parameters, **(changed or {})}, regions, known.prompt)
    except UserError as error:
        if changed:
            raise
        raise _Unusable(f"{path}: cannot be read any more ({error})") from None
    if not changed and identity(scene, config, folder)["scene_hash"] != known.scene_hash:
        raise _Unusable(f"{path}: it, or a file that it reads, was changed since the run")
    return scene


def _copy(
    folder: Path, known: _Identity, config: RunConfig, copies: _Copies, changed: dict[str, str] | None
) -> EditScene:
    place = folder / copies.scene
    regions = None if copies.regions is None else folder / copies.regions
    scene = load_edit_scene(place, {**known.parameters, **(changed or {})}, regions, known.prompt)
    if not changed and identity(scene, config, folder)["scene_hash"] != known.scene_hash:
        raise UserError(f"{place}: this copy of the run's scene was changed, too; put the scene back as it was")
    return scene


def _place(folder: Path, path: str) -> Path:
    """Where a path of `run.json` leads to, without the way through the run folder."""
    return (folder.resolve() / path).resolve()


def _identity(folder: Path) -> _Identity:
    known = _read(folder / "run.json")
    try:
        return _Identity.model_validate({**known, "copy_": known.get("copy")})
    except ValidationError as error:
        key = ".".join(str(part).rstrip("_") for part in error.errors()[0]["loc"])
        raise UserError(f"{folder / 'run.json'}: {key}: is missing or was damaged; start the run anew") from None


def _settings(folder: Path) -> RunConfig:
    settings = _read(folder / "config.json")
    try:
        return RunConfig.model_validate(settings)
    except ValidationError as error:
        key = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise UserError(
            f"{folder / 'config.json'}: {key}: was damaged, or is of another version of fd_mitsuba; use that version"
        ) from None


def _read(path: Path) -> dict:
    if not path.parent.is_dir():
        raise UserError(f"{path.parent}: no such run folder; give the -o folder of a run")
    if not path.is_file():
        raise UserError(f"{path.parent}: not a run (no {path.name}); give the -o folder of a run")
    data = read_json_object(path)
    if data is None:
        raise UserError(f"{path}: is damaged ({json_fault(path)}); start the run anew in another folder")
    return data
