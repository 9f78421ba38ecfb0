"""What a run tells while it goes on: a progress line, `metrics.jsonl`, contact sheets, its memory."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.json_object import parse_json_object
from fd_mitsuba.io.picture import write_picture

_SHOWN = ("loss_sds", "loss_focal", "loss_collision", "volume_ratio")
_PLAIN_EVERY_SECONDS = 15.0


def read_metrics(path: Path) -> list[dict]:
    """The rows of a metrics file; a last line that a kill cut short is dropped."""
    rows = []
    if path.is_file():
        with open(path, encoding="utf-8", errors="replace") as file:
            for line in file:
                row = parse_json_object(line)
                if row is None:
                    break
                rows.append(row)
    return rows


class Recorder:
    """Context manager that owns the metrics file and the progress display of one stage.

    Args:
        folder: the run folder.
        stage: its name in every row.
        total: steps of the stage.
        done: steps that are finished already; later rows of an interrupted run are cut from the metrics file.
        quiet: no progress display.
    """

    def __init__(self, folder: Path, stage: str, total: int, done: int = 0, quiet: bool = False) -> None:
        self._path, self._stage, self._total, self._done = folder / "metrics.jsonl", stage, total, done
        self._images = folder / "images"
        self._console = Console(stderr=True)
        self._live = self._console.is_terminal and not quiet
        self._quiet = quiet
        self._progress: Progress | None = None
        self._file: IO[str] | None = None
        self._started = self._spoken = time.monotonic()

    def __enter__(self) -> Recorder:
        rows = read_metrics(self._path)
        kept = [row for row in rows if row.get("stage") != self._stage or row.get("step", 0) <= self._done]
        # Renamed into place: a kill between emptying the file and writing it again would cost all rows.
        write_atomically(self._path, "".join(json.dumps(row) + "\n" for row in kept).encode())
        self._file = open(self._path, "a", encoding="utf-8")  # noqa: SIM115 - closed in __exit__
        if self._live:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("ETA"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[values]}"),
                console=self._console,
            )
            self._progress.start()
            self._task = self._progress.add_task(self._stage, total=self._total, completed=self._done, values="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.stop()
        if self._file is not None:
            self._file.close()

    def row(self, step: int, phase: str, values: dict[str, float]) -> None:
        """Append one row to `metrics.jsonl` (`step` counts finished steps) and move the display on."""
        row = {
            "stage": self._stage,
            "phase": phase,
            "step": step,
            "seconds": round(time.monotonic() - self._started, 3),
        }
        assert self._file is not None
        self._file.write(json.dumps({**row, **{name: _short(value) for name, value in values.items()}}) + "\n")
        self._file.flush()
        shown = "  ".join(f"{name.removeprefix('loss_')} {values[name]:.3g}" for name in _SHOWN if name in values)
        if self._progress is not None:
            self._progress.update(self._task, completed=step, description=phase, values=shown)
        elif not self._quiet and (time.monotonic() - self._spoken > _PLAIN_EVERY_SECONDS or step == self._total):
            self._spoken = time.monotonic()
            rate = (self._spoken - self._started) / max(step - self._done, 1)
            self._console.print(
                f"{phase} {step}/{self._total}  {rate:.2f} s/step  ETA {rate * (self._total - step):.0f} s  {shown}",
                highlight=False,
                soft_wrap=True,  # into a file, a line stays a line
            )

    def sheet(self, step: int, picture: np.ndarray) -> Path:
        """Write the step's contact sheet (H, W, 3) uint8 as `images/step_NNNNNN.png`, or under the stage's name."""
        prefix = "step" if self._stage == "geometry" else self._stage
        path = self._images / f"{prefix}_{step:06d}.png"
        write_picture(path, Image.fromarray(picture))
        return path


def _short(value: float) -> float:
    return float(f"{value:.6g}")
