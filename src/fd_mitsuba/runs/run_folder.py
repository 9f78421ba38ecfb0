"""The run folder: whose it is, and what the run in it is made of."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fd_mitsuba import __version__
from fd_mitsuba.backend.threads import cores_in_use
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.identity import changeable_settings, flat_settings
from fd_mitsuba.errors import Interrupted, RunStopped, UserError
from fd_mitsuba.io.atomic import is_litter, write_atomically
from fd_mitsuba.io.json_object import read_json_object, write_json
from fd_mitsuba.runs.run_lock import LOCK_NAME
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.scene_copy import SceneCopy
from fd_mitsuba.training.checkpoint import checkpoint_folder, list_checkpoints

_IDENTITY_NAME, _SETTINGS_NAME = "run.json", "config.json"
_FILES = (_SETTINGS_NAME, "environment.json", "command.txt", "metrics.jsonl", "report.html", _IDENTITY_NAME)
_FOLDERS = ("scene", "images", "checkpoints")
TRIES_FOLDER, TRIES_RECORD = "tries", "tries.json"
"""What lies in a run folder before the run itself where several seeds are tried."""
LIVE_FOLDER = "live"
"""What lies there before the run where it was started from the studio: its order, and what it tells of itself."""


def check_folder(scene: EditScene, config: RunConfig, folder: Path, resume: bool) -> list[str]:
    """Refuse a run folder that holds something else, or an interrupted run of other input or without `resume`.

    What an interrupted write left behind does not count: a run that was killed in its first moment can start again.

    Returns:
        A line about the settings that differ from the run's, all of them such as `--resume` may change; or none.

    Raises:
        UserError: as above, or a file instead of a folder.
    """
    refuse_strange_folder(folder)
    if not (folder / _IDENTITY_NAME).exists():
        return []
    if not resume:
        raise UserError(f"{folder}: holds a run already; add --resume to go on with it, or choose another -o folder")
    _refuse_other_run(scene, config, folder)
    return _changed_on_the_way(config, folder)


def refuse_strange_folder(folder: Path) -> None:
    """UserError for a file, and for a folder that is neither empty nor a run's."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; choose another -o folder")
    before = (LOCK_NAME, TRIES_FOLDER, TRIES_RECORD, LIVE_FOLDER)
    if not folder.exists() or all(is_litter(path) or path.name in before for path in folder.iterdir()):
        return
    if not (folder / _IDENTITY_NAME).exists():
        raise UserError(f"{folder}: not empty and not a run; choose another -o folder")


def describe_run(scene: EditScene, config: RunConfig, folder: Path, command: str) -> None:
    """Make the run folder and write down what the run is made of: command, settings, environment, the scene's files.

    Raises:
        UserError: the folder cannot be written.
    """
    # The identity comes first: from then on the folder is a run's, whenever it is killed.
    copy = SceneCopy.of(scene)
    write_json(folder / _IDENTITY_NAME, identity(scene, config, folder) | {"copy": _places(copy)})
    for path in folder.rglob(".*"):
        if is_litter(path):
            path.unlink(missing_ok=True)
    write_json(folder / _SETTINGS_NAME, config.model_dump(mode="json"))
    write_json(folder / "environment.json", _environment())
    commands = folder / "command.txt"
    earlier = commands.read_text(encoding="utf-8", errors="replace") if commands.exists() else ""
    write_atomically(commands, f"{earlier}{command}\n".encode())
    _copy_scene(copy, folder / "scene")


@contextmanager
def discarded_without_checkpoint(folder: Path) -> Iterator[None]:
    """Around the steps of a run: when they end with an error before the first checkpoint, what was written goes again.

    So the same command can be repeated once the cause is mended. An interrupted run stays as it is. Opened only for a
    folder that `check_folder` has let pass: no file in it is anybody else's.

    Raises:
        RunStopped: with what is left and how to go on added to its message.
    """
    try:
        yield
    except Interrupted:
        raise
    except Exception as error:
        kept = [path for stage in sorted(folder.glob("checkpoints*")) for path in list_checkpoints(stage)]
        if not kept:
            _discard(folder)
        if not isinstance(error, RunStopped):
            raise
        if not kept:
            raise RunStopped(f"{error}; no step was kept, so the same -o can be used again") from None
        step = int(kept[-1].stem[5:])
        raise RunStopped(
            f"{error}; {folder} keeps the state after step {step}: try other settings with another -o, or go on with "
            "the same by --resume"
        ) from None


def identity(scene: EditScene, config: RunConfig, folder: Path) -> dict:
    """What `run.json` holds: the scene by path and content, prompts, `-D` parameters, the settings' hash.

    Paths are relative to the run folder: they hold on when both are moved together, and say less of the machine.
    """
    digest, known = hashlib.sha256(), set()
    for file in scene.files:
        name, data = Path(file).name, Path(file).read_bytes()
        # By name and content, each once: in a copy, one file may have become two.
        if (key := (name, hashlib.sha256(data).digest())) not in known:
            known.add(key)
            digest.update(f"{name} {len(data)}\n".encode())
            digest.update(data)
    return {
        "scene": _relative(scene.path, folder),
        "scene_name": scene.path.resolve().parent.name,
        "scene_hash": digest.hexdigest()[:16],
        "prompt": scene.prompt,
        "base_prompt": scene.base_prompt,
        "regions": None if scene.regions_path is None else _relative(scene.regions_path, folder),
        "parameters": scene.regions_parameters | scene.parameters,
        "config_hash": config.content_hash(),
    }


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _places(copy: SceneCopy) -> dict[str, str | None]:
    """Where in the run folder the copies of the scene file and of the file of regions are."""
    regions = None if copy.regions is None else f"scene/{copy.regions}"
    return {"scene": f"scene/{copy.scene}", "regions": regions}


def _refuse_other_run(scene: EditScene, config: RunConfig, folder: Path) -> None:
    known, now = _read_json(folder / _IDENTITY_NAME), identity(scene, config, folder)
    remedy = "resume with the run's own scene, --prompt, -c, --set and -D, or choose another -o folder"
    for key in ("prompt", "parameters"):
        if known.get(key) != now[key]:
            raise UserError(f"{folder}: holds a run with other {key} ({known.get(key)!r}, now {now[key]!r}); {remedy}")
    if known.get("scene_hash") != now["scene_hash"]:
        copy = f"; the scene as it was is in {folder / 'scene'}" if (folder / "scene").is_dir() else ""
        raise UserError(
            f"{folder}: holds a run of another scene, or a file of the scene was changed since; {remedy}{copy}"
        )
    # Only the settings that a finished or begun stage has used count.
    stage = "appearance" if list_checkpoints(checkpoint_folder(folder, "appearance")) else "geometry"
    before = _settings(folder)
    changed = {} if before is None else _differences(before.identity(stage), config.identity(stage))
    if changed or known.get("config_hash") != now["config_hash"]:
        words = [f"{key} = {was}, now {value}" for key, (was, value) in changed.items()]
        raise UserError(f"{folder}: holds a run with other settings ({'; '.join(words[:3]) or 'unknown'}); {remedy}")


def _changed_on_the_way(config: RunConfig, folder: Path) -> list[str]:
    before = _settings(folder)
    if before is None:
        return []
    marked = changeable_settings(RunConfig)
    found = _differences(flat_settings(before.model_dump(mode="json")), flat_settings(config.model_dump(mode="json")))
    words = [f"{key} = {value} (was {was})" for key, (was, value) in found.items() if key in marked]
    return [f"{folder}: goes on with {', '.join(words)}; the result stays that of the same run"] if words else []


def _differences(before: dict[str, Any], now: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Key -> value before and value now, of those that differ."""
    keys = dict.fromkeys([*now, *before])
    return {key: (before.get(key), now.get(key)) for key in keys if before.get(key) != now.get(key)}


def _settings(folder: Path) -> RunConfig | None:
    """The settings of the run in the folder; None where they cannot be read."""
    try:
        return RunConfig.model_validate(read_json_object(folder / _SETTINGS_NAME))
    except ValidationError:
        return None


def _discard(folder: Path) -> None:
    for name in _FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)
    # The identity goes last: until then, whatever is left is a run's and no stranger's.
    with suppress(OSError):
        for path in [*filter(is_litter, folder.glob(".*")), *(folder / name for name in _FILES)]:
            path.unlink(missing_ok=True)
        folder.rmdir()


def _read_json(path: Path) -> dict:
    data = read_json_object(path)
    if data is None:
        raise UserError(f"{path}: cannot be read, so the run cannot be resumed; choose another -o folder")
    return data


def _copy_scene(copy: SceneCopy, folder: Path) -> None:
    """Copies of every file that the scene reads: what the run is read from when the originals are gone."""
    for place, source in copy.files.items():
        if not (folder / place).exists():
            write_atomically(folder / place, source.read_bytes())
    for place, names in copy.names.items():
        write_json(folder / place, names)


def _environment() -> dict[str, str | int]:
    """What the run's bytes depend on beside scene and settings; `threads` are the cores that it may use, as `-t`."""
    names = ("mitsuba", "drjit", "torch", "diffusers", "transformers", "numpy", "libigl")
    return {
        "fd_mitsuba": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": cores_in_use(),
        **{name: metadata.version(name) for name in names},
    }
