"""The studio's own folder: the scene as it was opened, what was changed since, the runs.

WORK/studio.json     regions, prompt, settings: what the page shows; written whenever it changes
WORK/scene/          a copy of the scene with all that it reads
WORK/scene/run_001.xml   the scene as run 001 has it, beside the same meshes
WORK/scene_2/        after "edit again": the exported result, which is the base of the second round; or a mesh
WORK/uploads/001/    a mesh and its images that were sent by the page
WORK/runs/001/       run folders, as of `fd_mitsuba run`
"""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.json_object import json_fault, read_json_object, write_json
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.scene_copy import SceneCopy

RECORD_NAME = "studio.json"
VERSION = 1


@dataclass(frozen=True)
class WorkFolder:
    """Paths of a work folder, and its record."""

    path: Path

    @property
    def record(self) -> Path:
        return self.path / RECORD_NAME

    @property
    def runs(self) -> Path:
        return self.path / "runs"

    def scene_folder(self, round_: int) -> Path:
        """Of the scene that round 1, 2 and so on starts from."""
        return self.path / ("scene" if round_ == 1 else f"scene_{round_}")

    def next_scene(self, after: int) -> int:
        """The number of the first round behind `after` whose folder is free."""
        return next(number for number in itertools.count(after + 1) if not self.scene_folder(number).exists())

    def next_run(self) -> Path:
        """A folder for the next run, `001`, `002` and so on; it is made, so that nobody else gets it."""
        return self._numbered(self.runs)

    def next_upload(self) -> Path:
        """A folder for the next files that the page sends, likewise."""
        return self._numbered(self.path / "uploads")

    def _numbered(self, home: Path) -> Path:
        taken = [int(path.name) for path in home.glob("[0-9]*") if path.name.isdecimal()]
        folder = home / f"{max(taken, default=0) + 1:03d}"
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise UserError(f"{folder}: cannot be made ({error.strerror or error}); free space there") from None
        return folder

    def read(self) -> dict[str, Any] | None:
        """The record; None where there is no work folder yet.

        Raises:
            UserError: the folder holds something else, or the record is damaged.
        """
        if not self.path.exists() or (self.path.is_dir() and not any(self.path.iterdir())):
            return None
        if not self.record.is_file():
            raise UserError(f"{self.path}: is no work folder of the studio and not empty; choose another -o folder")
        data = read_json_object(self.record)
        if data is None or data.get("version") != VERSION:
            fault = json_fault(self.record) or "version: another one"
            raise UserError(f"{self.record}: is damaged or of another version ({fault}); choose another -o folder")
        return data

    def adopted(self) -> list[Path]:
        """Run folders from elsewhere that the record names, as far as they are still there."""
        named = (read_json_object(self.record) or {}).get("adopted")
        found = [self.path / str(place) for place in named] if isinstance(named, list) else []
        return [folder for folder in found if (folder / "run.json").is_file()]

    def write(self, data: dict[str, Any]) -> None:
        """Replace the record; UserError where the folder cannot be written."""
        write_json(self.record, {"version": VERSION, **data})

    def copy_scene(self, scene: EditScene) -> Path:
        """Copy a scene with all that it reads; the path of its copy. Files that are there already are replaced."""
        plan, home = SceneCopy.of(scene), self.scene_folder(1)
        for place, source in plan.files.items():
            data = source.read_bytes()
            target = home / place
            if not target.is_file() or target.read_bytes() != data:
                write_atomically(target, data)
        for place, names in plan.names.items():
            write_json(home / place, names)
        return home / plan.scene

    def relative(self, path: Path, base: Path | None = None) -> str:
        """`path` as seen from the work folder, or from `base`: it holds on when both are moved together."""
        return Path(os.path.relpath(path.resolve(), (base or self.path).resolve())).as_posix()
