"""What the studio and a run tell each other: files in the run folder, so that neither needs the other to live.

    RUN/live/job.json       what is to be done; written by the studio
    RUN/live/events.jsonl   what the run has done: one JSON object a line, appended
    RUN/live/part.ply       the growing part as it was at the newest `mesh` event, user frame; replaced as a whole
    RUN/live/part.glb       the part with its material as it was at the newest `material` event, likewise
    RUN/live/log.txt        what the process printed

Events: `begun`, `said` (a line for people), `step` (stage, phase, step, total, losses), `mesh` (step, faces),
`material` (step), `finished`, `stopped` and `failed` (with the line to show).
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import parse_json_object, read_json_object, write_json
from fd_mitsuba.runs.run_folder import LIVE_FOLDER

MESH_NAME, MATERIAL_NAME = "part.ply", "part.glb"
SHOW_EVERY = 10
"""Steps between two meshes or materials; the first comes after the first step."""


@dataclass(frozen=True)
class RunOrder:
    """What a run is to do.

    Attributes:
        scene: the scene file, relative to the run folder.
        prompt: instead of the scene's.
        config: all settings, as `RunConfig.model_dump(mode="json")` gives them.
        parameters: the scene's `-D` values.
        threads: as for `-t`.
        variant: Mitsuba's.
        resume: go on with the run in the folder.
    """

    scene: str
    prompt: str
    config: dict[str, Any]
    parameters: dict[str, str] = field(default_factory=dict)
    threads: int = 0
    variant: str = "llvm_ad_rgb"
    resume: bool = False

    def write(self, folder: Path) -> None:
        """Put the order into a run folder; UserError where that cannot be written."""
        write_json(folder / LIVE_FOLDER / "job.json", dict(vars(self)))

    @classmethod
    def read(cls, folder: Path) -> RunOrder:
        """The order in a run folder; UserError where there is none that can be read."""
        path = folder / LIVE_FOLDER / "job.json"
        data = read_json_object(path) or {}
        try:
            order = cls(**data)
        except TypeError:
            raise UserError(f"{path}: is missing or damaged; grow the part anew") from None
        plain = isinstance(order.scene, str) and isinstance(order.prompt, str) and isinstance(order.config, dict)
        if not plain or not isinstance(order.parameters, dict):
            raise UserError(f"{path}: is missing or damaged; grow the part anew")
        return order


class EventWriter:
    """Appends events to a run's file; each line is there as soon as `write` returns."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / LIVE_FOLDER / "events.jsonl"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # A line that a kill cut short is ended first, or it would take the next one with it.
        before = self.path.read_bytes()[-1:] if self.path.is_file() else b""
        self._start = "" if before in (b"", b"\n") else "\n"

    def write(self, event: str, **values: Any) -> None:
        """Append one event; numbers and text only."""
        row = json.dumps({"event": event, "time": round(time.time(), 3), **values})
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(f"{self._start}{row}\n")
        self._start = ""


class EventReader:
    """Reads what was appended to a run's events since the last time; a line that is not finished waits."""

    def __init__(self, folder: Path) -> None:
        self.path, self._offset = folder / LIVE_FOLDER / "events.jsonl", 0

    def new(self) -> Iterator[dict[str, Any]]:
        """The events since the last call; lines that cannot be read are passed over."""
        try:
            with open(self.path, "rb") as file:
                file.seek(self._offset)
                data = file.read()
        except OSError:
            return
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.decode(errors="replace").splitlines():
            row = parse_json_object(line)
            if row is not None and isinstance(row.get("event"), str):
                yield row
