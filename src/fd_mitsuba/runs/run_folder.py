"""The run folder: whose it is, and what the run in it is made of."""

from __future__ import annotations

import hashlib
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

import torch

from fd_mitsuba import __version__
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import RunStopped, UserError
from fd_mitsuba.io.atomic import is_litter, write_atomically
from fd_mitsuba.io.json_object import read_json_object, write_json
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.checkpoint import list_checkpoints

_IDENTITY_NAME, _SETTINGS_NAME = "run.json", "config.json"
_FILES = (_SETTINGS_NAME, "environment.json", "command.txt", "metrics.jsonl", "report.html", _IDENTITY_NAME)
_FOLDERS = ("scene", "images", "checkpoints")


def check_folder(scene: EditScene, config: RunConfig, folder: Path, resume: bool) -> None:
    """Refuse a run folder that holds something else, or an interrupted run of other input or without `resume`.

    What an interrupted write left behind does not count: a run that was killed in its first moment can start again.

    Raises:
        UserError: as above, or a file instead of a folder.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; choose another -o folder")
    if not folder.exists() or all(is_litter(path) for path in folder.iterdir()):
        return
    if not (folder / _IDENTITY_NAME).exists():
        raise UserError(f"{folder}: not empty and not a run; choose another -o folder")
    if not resume:
        raise UserError(f"{folder}: holds a run already; add --resume to go on with it, or choose another -o folder")
    _refuse_other_run(scene, config, folder)


def describe_run(scene: EditScene, config: RunConfig, folder: Path, command: str) -> None:
    """Make the run folder and write down what the run is made of: command, settings, environment, the scene's files.

    Raises:
        UserError: the folder cannot be written.
    """
    # The identity comes first: from then on the folder is a run's, whenever it is killed.
    write_json(folder / _IDENTITY_NAME, identity(scene, config))
    for path in folder.rglob(".*"):
        if is_litter(path):
            path.unlink(missing_ok=True)
    write_json(folder / _SETTINGS_NAME, config.model_dump(mode="json"))
    write_json(folder / "environment.json", _environment())
    commands = folder / "command.txt"
    earlier = commands.read_text(encoding="utf-8", errors="replace") if commands.exists() else ""
    write_atomically(commands, f"{earlier}{command}\n".encode())
    _copy_scene(scene, folder / "scene")


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
    except (UserError, OSError) as error:
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


def identity(scene: EditScene, config: RunConfig) -> dict:
    """What `run.json` holds: the scene by path and content, prompts, `-D` parameters, the settings' hash."""
    digest = hashlib.sha256()
    for file in scene.files:
        data = Path(file).read_bytes()
        digest.update(f"{Path(file).name} {len(data)}\n".encode() + data)
    return {
        "scene": str(scene.path.resolve()),
        "scene_hash": digest.hexdigest()[:16],
        "prompt": scene.prompt,
        "base_prompt": scene.base_prompt,
        "regions": None if scene.regions_path is None else str(scene.regions_path.resolve()),
        "parameters": scene.regions_parameters | scene.parameters,
        "config_hash": config.content_hash(),
    }


def _refuse_other_run(scene: EditScene, config: RunConfig, folder: Path) -> None:
    known, now = _read_json(folder / _IDENTITY_NAME), identity(scene, config)
    remedy = "resume with the run's own scene, --prompt, -c, --set and -D, or choose another -o folder"
    for key in ("prompt", "parameters"):
        if known.get(key) != now[key]:
            raise UserError(f"{folder}: holds a run with other {key} ({known.get(key)!r}, now {now[key]!r}); {remedy}")
    if known.get("scene_hash") != now["scene_hash"]:
        raise UserError(f"{folder}: holds a run of another scene, or a file of the scene was changed since; {remedy}")
    if known.get("config_hash") != now["config_hash"]:
        before, after = _flat(_read_json(folder / _SETTINGS_NAME)), _flat(config.model_dump(mode="json"))
        changed = [
            f"{key} = {before.get(key)}, now {value}" for key, value in after.items() if before.get(key) != value
        ]
        raise UserError(f"{folder}: holds a run with other settings ({'; '.join(changed[:3]) or 'unknown'}); {remedy}")


def _discard(folder: Path) -> None:
    for name in _FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)
    # The identity goes last: until then, whatever is left is a run's and no stranger's.
    with suppress(OSError):
        for path in [*filter(is_litter, folder.glob(".*")), *(folder / name for name in _FILES)]:
            path.unlink(missing_ok=True)
        folder.rmdir()


def _flat(settings: dict) -> dict:
    sections = {k: v for k, v in settings.items() if isinstance(v, dict)}
    inner = {f"{section}.{key}": value for section, values in sections.items() for key, value in values.items()}
    return {k: v for k, v in settings.items() if k not in sections} | inner


def _read_json(path: Path) -> dict:
    data = read_json_object(path)
    if data is None:
        raise UserError(f"{path}: cannot be read, so the run cannot be resumed; choose another -o folder")
    return data


def _copy_scene(scene: EditScene, folder: Path) -> None:
    """Copies of every file that the scene reads, for the record; the run itself reads the originals.

    What lies below the scene's folder keeps its place, the rest goes with its whole path below `elsewhere`.
    """
    root = scene.path.resolve().parent
    for file in scene.files:
        source = Path(file).resolve()
        place = source.relative_to(root) if source.is_relative_to(root) else Path("elsewhere", *source.parts[1:])
        if not (folder / place).exists():
            write_atomically(folder / place, source.read_bytes())


def _environment() -> dict[str, str | int]:
    names = ("mitsuba", "drjit", "torch", "diffusers", "transformers", "numpy", "libigl")
    return {
        "fd_mitsuba": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": torch.get_num_threads(),
        **{name: metadata.version(name) for name in names},
    }
