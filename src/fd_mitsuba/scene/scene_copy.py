"""A copy of a scene with all that it reads, in one folder that can be moved: what a run keeps in its `scene/`.

    scene.xml, cat.ply, ...     what lies below the scene's folder keeps its place
    elsewhere/city.exr          what lies elsewhere; a second file of that name goes to elsewhere/2/
    elsewhere/names.json        what those files are called in the scene: {"../lighting/city.exr": "elsewhere/city.exr"}
    elsewhere/regions/...       the file given with --regions, where it lies elsewhere, copied in the same way

The scene file itself is copied as it is. Whoever reads a scene finds the other files by `names.json`, so a copy can be
run, checked and edited like any other scene, and nothing in it says where the files came from.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import json_fault

if TYPE_CHECKING:
    from fd_mitsuba.scene.edit_scene import EditScene

ELSEWHERE = "elsewhere"
_NAMES, _REGIONS = "names.json", "regions"
_MOST_BYTES = 1 << 20


@dataclass
class SceneCopy:
    """What goes where, relative to the copy's folder.

    Attributes:
        files: place -> the file that is copied there.
        names: place of a `names.json` -> what it holds.
        scene, regions: places of the scene file and of the file of regions, if there is one.
    """

    files: dict[PurePosixPath, Path] = field(default_factory=dict)
    names: dict[PurePosixPath, dict[str, str]] = field(default_factory=dict)
    scene: PurePosixPath = PurePosixPath()
    regions: PurePosixPath | None = None

    @classmethod
    def of(cls, scene: EditScene) -> SceneCopy:
        """The plan for a scene; nothing is read but what says which files there are."""
        inputs, plan = scene.inputs, cls()
        home = scene.path.parent
        listed = dict.fromkeys(inputs.files)
        beside = [path for path in scene.files if path not in listed]  # such as the record of earlier rounds
        plan._add(PurePosixPath(), home, [*inputs.scene.text.files, *beside], inputs.scene.files)
        plan.scene = PurePosixPath(scene.path.name)
        if inputs.regions is not None:
            source = inputs.regions.path
            below = _below(source.parent, home)
            root = PurePosixPath(ELSEWHERE, _REGIONS) if below is None else below
            names = {element.properties.get("filename") for _, element in inputs.region_elements()}
            read = {name: path for name, path in inputs.regions.files.items() if name in names}
            plan._add(root, source.parent, inputs.regions.text.files, read)
            plan.regions = root / source.name
        return plan

    def _add(self, root: PurePosixPath, home: Path, texts: Iterable[Path], files: Mapping[str, Path]) -> None:
        for path in texts:
            place = _below(path, home)
            self.files[root / (path.name if place is None else place)] = path
        for name, path in files.items():
            below = _below(path, home)
            place = self._free(root, path) if below is None else root / below
            self.files.setdefault(place, path)
            within = place.relative_to(root)
            if os.path.normpath(name) != str(within):
                self.names.setdefault(root / ELSEWHERE / _NAMES, {})[name] = str(within)

    def _free(self, root: PurePosixPath, path: Path) -> PurePosixPath:
        """Where a file from elsewhere goes: the first place that is free, or its own."""
        folders = itertools.chain([root / ELSEWHERE], (root / ELSEWHERE / str(n) for n in itertools.count(2)))
        taken = {_NAMES, _REGIONS}
        for folder in folders:
            place = folder / path.name
            known = self.files.get(place)
            if (known is None and not (folder.name == ELSEWHERE and path.name in taken)) or known == path:
                return place
        raise AssertionError("there are numbers without end")


def copied_files(scene: Path) -> dict[str, Path]:
    """Name in a scene file -> file, for those that a copy of a scene keeps in another place than the name says.

    Raises:
        UserError: a `names.json` that was damaged, or names a place outside of the scene's folder.
    """
    folder = scene.resolve().parent
    path = folder / ELSEWHERE / _NAMES
    if not path.is_file():
        return {}
    try:
        names = json.loads(path.read_text(encoding="utf-8")) if path.stat().st_size <= _MOST_BYTES else None
    except (OSError, ValueError, RecursionError):
        names = None
    names = names if isinstance(names, dict) else {}
    places = [PurePosixPath(str(place)) for place in names.values()]
    if not places or any(place.is_absolute() or ".." in place.parts for place in places):
        fault = json_fault(path) or "names: a place outside this folder, or none"
        raise UserError(
            f"{path}: is damaged ({fault}); put the scene's files where the scene names them, and delete this file"
        )
    return {name: folder / place for name, place in zip(names, places, strict=True)}


def _below(path: Path, home: Path) -> PurePosixPath | None:
    """`path` relative to `home` as it is written, or as it is found; None where it lies elsewhere."""
    for spell in (os.path.abspath, os.path.realpath):
        own, base = spell(path), spell(home)
        if own == base or own.startswith(base.rstrip(os.sep) + os.sep):
            return PurePosixPath(os.path.relpath(own, base))
    return None
