"""What a run folder is a run of: its scene and its settings, read back."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run_folder import identity
from fd_mitsuba.scene.edit_scene import EditScene, load_edit_scene


def saved_run(folder: Path, changed: dict[str, str] | None = None) -> tuple[EditScene, RunConfig]:
    """The scene and the settings of a run, from where the scene lay when the run was started.

    Args:
        changed: other values for some of the scene's `$name`, as for another light; the scene's files may then differ.

    Raises:
        UserError: no run there, settings of another version, a scene that is gone or was changed since.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such run folder; give the -o folder of a run")
    known, settings = (_read(folder / name) for name in ("run.json", "config.json"))
    try:
        config = RunConfig.model_validate(settings)
    except ValidationError as error:
        key = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise UserError(
            f"{folder / 'config.json'}: {key}: is of another version of fd_mitsuba; use that version"
        ) from None
    path, parameters, regions = Path(str(known.get("scene"))), known.get("parameters"), known.get("regions")
    if not isinstance(parameters, dict):
        raise UserError(f"{folder / 'run.json'}: has no parameters; it was damaged, start the run anew")
    for file in (path, path if regions is None else Path(regions)):
        if not file.is_file():
            raise UserError(f"{file}: the run's scene is gone; put it back (a copy is in {folder / 'scene'})")
    scene = load_edit_scene(path, {**parameters, **(changed or {})}, regions, str(known.get("prompt")))
    if not changed and identity(scene, config)["scene_hash"] != known.get("scene_hash"):
        raise UserError(
            f"{path}: it, or a file that it reads, was changed since the run; put back the copy in {folder / 'scene'}"
        )
    return scene, config


def _read(path: Path) -> dict:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise UserError(f"{path.parent}: not a run (no {path.name}); give the -o folder of a run") from None
    except ValueError:
        data = None
    if not isinstance(data, dict):
        raise UserError(f"{path}: is damaged; start the run anew in another folder")
    return data
