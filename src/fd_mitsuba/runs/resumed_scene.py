"""Where a run that is resumed finds its scene; without torch, which is loaded after the cores are shared out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fd_mitsuba.io.json_object import read_json_object


def resumed_scene(folder: Path, scene: str, regions: str | None, say: Callable[[str], None]) -> tuple[str, str | None]:
    """The scene file and the file of regions to resume a run with: as given, or the run's own copies of those.

    A copy takes the place of a file that is gone, if it was this run's: see `saved_run` for the same rule elsewhere.
    """
    known = read_json_object(folder / "run.json") or {}
    copies = known.get("copy")
    if not isinstance(copies, dict):
        return scene, regions
    found = []
    for key, given in (("scene", scene), ("regions", regions)):
        recorded, copy = known.get(key), copies.get(key)
        gone = given is not None and not Path(given).exists()
        if given and gone and isinstance(recorded, str) and isinstance(copy, str) and (folder / copy).is_file():
            if (folder.resolve() / recorded).resolve() == Path(given).resolve():
                say(f"{given}: the run's scene is gone; taking the copy of it in {(folder / copy).parent}")
                given = str(folder / copy)
        found.append(given)
    return found[0] or scene, found[1]
