"""One page over many runs: pictures before and after, prompts and figures in a table, and links to the reports."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.report.metric_table import duration
from fd_mitsuba.evaluation.report.run_page import PAGE, page_template, photographs, shape_films
from fd_mitsuba.evaluation.report.run_record import RunRecord, read_run
from fd_mitsuba.evaluation.report.score_table import COLUMNS
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.safe_text import quoted_link
from fd_mitsuba.viewing.film_strip import Strip, common_crop, strip, video_frames

_THUMB_FRAMES, _THUMB_SIZE = 12, 160
_EVALUATED = ("sim", "dir", "dir_cosine", "rank", "rank_part", "valid")


class Cell(NamedTuple):
    """A figure as a number to sort by, and as text."""

    value: float | None
    text: str


class GalleryRow(NamedTuple):
    """A run."""

    name: str
    link: str | None
    prompt: str
    state: str
    finished: bool
    before: Strip | None
    after: Strip | None
    around: Strip | None
    cells: list[Cell]


class _Column(NamedTuple):
    title: str
    value: Callable[[RunRecord], float | None]
    text: Callable[[float], str]


def _metric(name: str, group: str | None = None) -> Callable[[RunRecord], float | None]:
    def value(run: RunRecord) -> float | None:
        holder = run.metrics if group is None else run.metrics.get(group, {})
        return _number(holder.get(name))

    return value


def _number(found: object) -> float | None:
    return float(found) if isinstance(found, int | float) else None


def _evaluated(key: str) -> _Column:
    column = COLUMNS[key]

    def value(run: RunRecord) -> float | None:
        try:
            return column.value(run.evaluation) if run.evaluation else None
        except (TypeError, ValueError, KeyError, AttributeError):
            return None

    return _Column(column.title, value, column.text)


_OWN = (
    _Column("seed", lambda run: _number(run.settings.get("seed")), "{:.0f}".format),
    _Column("inside region", _metric("inside_fraction"), "{:.1%}".format),
    _Column("overlap", _metric("overlap_fraction"), "{:.1%}".format),
    _Column("base PSNR, dB", _metric("base_psnr_db", "appearance"), "{:.0f}".format),
    _Column("time", lambda run: sum(run.seconds().values()) or None, duration),
)


def write_gallery(folders: Sequence[Path], path: Path, title: str = "Runs", say: Callable[[str], None] = print) -> Path:
    """Write the page; returns its path.

    Args:
        folders: run folders, finished or not. Each is linked to its `report.html` where there is one. One that is no
            run, or a damaged one, has a row that says so and costs the others nothing.
        say: takes a line for each of those.

    Raises:
        UserError: none of them can be shown, or the page cannot be written.
    """
    runs: list[RunRecord] = []
    bad: dict[Path, str] = {}
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except UserError as error:
            bad[folder] = str(error)
    columns = [*_OWN, *(_evaluated(key) for key in _EVALUATED)]
    columns = [column for column in columns if any(column.value(run) is not None for run in runs)]
    shown = {}
    for run in runs:
        try:
            shown[run.folder] = _row(run, columns, path.resolve().parent)
        except Exception as error:
            bad[run.folder] = " ".join(f"{run.folder}: cannot be shown ({type(error).__name__}: {error})".split())
    if folders and not shown:
        raise UserError(next(iter(bad.values())))
    for line in bad.values():
        say(line)
    rows = [shown.get(folder) or _bad_row(folder, bad[folder], len(columns)) for folder in folders]
    clips = [run.evaluation.get("clip") for run in runs]
    judges = sorted({str(clip.get("judge")) for clip in clips if isinstance(clip, dict) and clip.get("judge")})
    text = page_template("gallery.html.j2").render(
        title=title,
        css=(PAGE / "page.css").read_text(encoding="utf-8"),
        js=(PAGE / "gallery.js").read_text(encoding="utf-8"),
        rows=rows,
        columns=[column.title for column in columns],
        finished=sum(run.finished for run in runs),
        means=_means(columns, rows) if len(rows) > 1 else None,
        judges=judges,
    )
    write_atomically(path, text.encode(errors="backslashreplace"))
    return path


def _row(run: RunRecord, columns: Sequence[_Column], root: Path) -> GalleryRow:
    report = run.folder / "report.html"
    link = quoted_link(Path(os.path.relpath(report.resolve(), root))) if report.is_file() else None
    before, after, around = _thumbs(run.folder)
    values = [column.value(run) for column in columns]
    cells = [
        Cell(value, "-" if value is None else column.text(value)) for column, value in zip(columns, values, strict=True)
    ]
    return GalleryRow(
        run.folder.resolve().name, link, run.prompt, run.state, run.finished, before, after, around, cells
    )


def _bad_row(folder: Path, reason: str, columns: int) -> GalleryRow:
    reason = reason.removeprefix(f"{folder}: ")
    return GalleryRow(folder.resolve().name, None, "", reason, False, None, None, None, [Cell(None, "-")] * columns)


def _thumbs(folder: Path) -> tuple[Strip | None, Strip | None, Strip | None]:
    """Before, after, and the object that turns in its light; the first two turn where there is no photograph."""
    film = video_frames(folder / "videos" / "appearance.mp4")
    around = None if film is None else strip(_some(film), None, _THUMB_SIZE)
    if (found := photographs(folder)) is not None:
        before, after = (strip(still, None, _THUMB_SIZE) for still in found)
        return before, after, around
    if (films := shape_films(folder)) is None:
        return None, None, around
    crop = common_crop(*films)
    before, after = (strip(_some(frames), crop, _THUMB_SIZE) for frames in films)
    return before, after, around


def _some(frames: np.ndarray) -> np.ndarray:
    return frames[np.linspace(0, len(frames), min(_THUMB_FRAMES, len(frames)), endpoint=False).astype(int)]


def _means(columns: Sequence[_Column], rows: Sequence[GalleryRow]) -> list[Cell]:
    means = []
    for number, column in enumerate(columns):
        values = [value for row in rows if (value := row.cells[number].value) is not None]
        mean = sum(values) / len(values) if values and column.title != "seed" else None
        means.append(Cell(mean, "" if mean is None else column.text(mean)))
    return means
