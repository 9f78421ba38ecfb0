"""A run that `fd_mitsuba run` began, as one of the studio's: shown, and gone on with."""

from __future__ import annotations

from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.runs.run_folder import LIVE_FOLDER
from fd_mitsuba.studio.job import RunOrder


def adopt(folder: Path) -> None:
    """Write the order of a run that has none, from what it says of itself.

    Raises:
        UserError: no run there, or one whose scene the studio cannot go on with.
    """
    if (folder / LIVE_FOLDER / "job.json").is_file():
        return
    known, config = read_json_object(folder / "run.json"), read_json_object(folder / "config.json")
    if known is None or config is None or known.get("regions") is not None:
        raise UserError(f"{folder}: is no run of a single scene file; give the -o folder of a run")
    scene, copy = known.get("scene"), (known.get("copy") or {}).get("scene")
    places = [place for place in (scene, copy) if isinstance(place, str) and (folder / place).is_file()]
    if not places:
        raise UserError(f"{folder}: its scene is gone, and so is its copy")
    RunOrder(places[0], str(known.get("prompt", "")), config, dict(known.get("parameters") or {})).write(folder)
