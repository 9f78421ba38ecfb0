"""What `fd_mitsuba studio` is given: a scene, a run, or a work folder of its own; and where its work folder is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.studio.work_folder import RECORD_NAME, WorkFolder


@dataclass(frozen=True)
class Opened:
    """Attributes:
    work: the work folder.
    scene: to start from; None: the work folder has its own.
    shown: name of the run to show first; "": the newest.
    run: a run from elsewhere to show; None: none.
    """

    work: WorkFolder
    scene: EditScene | None
    shown: str = ""
    run: Path | None = None


def open_target(
    target: Path,
    output: Path | None,
    parameters: dict[str, str],
    prompt: str | None = None,
    say: Callable[[str], None] = print,
) -> Opened:
    """Find out what `target` is, and read its scene.

    Args:
        target: a scene file, a run folder, or a work folder.
        output: the work folder; None: `runs/studio_<name>`, or the one that the target is or lies in.

    Raises:
        UserError: nothing of these, or a scene that cannot be edited here.
    """
    if (target / RECORD_NAME).is_file():
        if output is not None and output.resolve() != target.resolve():
            raise UserError(f"{target}: is a work folder already; leave out -o {output}")
        return Opened(WorkFolder(target), None)
    if (target / "run.json").is_file() or (target / "live" / "job.json").is_file():
        return _run(target, output, say)
    # A mesh file was imported by the command; whatever else is to be opened becomes a scene file before it comes here.
    scene = load_edit_scene(
        target, parameters, None, prompt, lambda error: say(f"warning: {error}"), needs_region=False
    )
    return Opened(WorkFolder(output or Path("runs") / f"studio_{_name(target)}"), scene)


def _run(folder: Path, output: Path | None, say: Callable[[str], None]) -> Opened:
    own = folder.resolve().parent.parent
    if (own / RECORD_NAME).is_file() and output is None:
        return Opened(WorkFolder(own), None, folder.name)
    from fd_mitsuba.runs.saved_run import saved_run

    scene, _ = saved_run(folder, say=say)
    if scene.regions_path is not None:
        raise UserError(
            f"{folder}: its regions are in a file beside the scene, which the studio does not change; write them into "
            "the scene"
        )
    name = (read_json_object(folder / "run.json") or {}).get("scene_name") or folder.name
    return Opened(WorkFolder(output or folder.parent / f"studio_{name}"), scene, folder.name, folder)


def _name(scene: Path) -> str:
    return scene.resolve().parent.name if scene.stem == "scene" else scene.stem
