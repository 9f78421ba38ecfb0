"""The table of an ablation, with the paper's numbers beside ours, and its sheet of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from fd_mitsuba.evaluation.ablation import RowResult
from fd_mitsuba.evaluation.junction import junction_pictures
from fd_mitsuba.evaluation.report.score_table import COLUMNS, Column, spread_text
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.runs.geometry_outcome import load_finished_stage
from fd_mitsuba.runs.saved_run import saved_run
from fd_mitsuba.viewing.turntable import write_sheet

_OF_LIT = ("sim", "dir", "drift", "step")
_OF_ALL = ("leakage", "overlap")
_OF_SHAPE = ("sim", "dir")
_TILE, _VIEWS, _EVALUATED = 160, 4, 8


def ablation_header() -> list[str]:
    """Titles above `ablation_rows`."""
    lit = [COLUMNS[name].title for name in _OF_LIT]
    shape = [f"{COLUMNS[name].title}, shape" for name in _OF_SHAPE]
    return ["run", "paper CLIP_sim", "paper CLIP_dir", *lit, *shape, *(COLUMNS[name].title for name in _OF_ALL), "runs"]


def ablation_rows(results: Sequence[RowResult]) -> list[list[str]]:
    """Text cells of each row: "mean ± standard deviation" over its runs, "-" where it has no such figure."""
    rows = []
    for result in results:
        cells = [result.row.title, *(text or "-" for text in result.row.paper)]
        cells += _cells([COLUMNS[name] for name in _OF_LIT], result.lit)
        cells += _cells([COLUMNS[name] for name in _OF_SHAPE], result.shape)
        cells += _cells([COLUMNS[name] for name in _OF_ALL], result.shape or result.lit)
        rows.append([*cells, str(len(result.folders))])
    return rows


def write_ablation_sheet(results: Sequence[RowResult], path: Path) -> None:
    """A PNG with a line for each row, of its first run: views from around, then two close-ups of the junction."""
    lines = {}
    for result in results:
        if result.folders:
            folder = result.folders[0]
            name = "evaluation.png" if result.lit else "evaluation_shape.png"
            lines[result.row.title] = np.concatenate([_edited_views(folder / "images" / name), junction_of(folder)])
    if lines:
        write_sheet(lines, path)


def junction_of(folder: Path) -> np.ndarray:
    """The close-ups (2, S, S, 3) of a run, kept as `images/junction.png` below its folder."""
    path = folder / "images" / "junction.png"
    if not path.is_file() or path.stat().st_mtime < (folder / "metrics.json").stat().st_mtime:
        scene, config = saved_run(folder)
        pictures = junction_pictures(load_finished_stage(scene, config, folder), _TILE)
        write_picture(path, Image.fromarray(np.concatenate(list(pictures), axis=1)))
    return _tiles(Image.open(path), 2)


def _edited_views(path: Path) -> np.ndarray:
    """Some of the tiles in the last line of `evaluate.views_sheet`."""
    sheet = Image.open(path).convert("RGB")
    side = sheet.height // 3
    line = sheet.crop((0, 2 * side, sheet.width, sheet.height))
    tiles = _tiles(line, max(1, sheet.width // side))
    return tiles[:: max(1, len(tiles) // _VIEWS)][:_VIEWS]


def _tiles(line: Image.Image, count: int) -> np.ndarray:
    line = line.convert("RGB").resize((count * _TILE, _TILE), Image.Resampling.LANCZOS)
    return np.asarray(line).reshape(_TILE, count, _TILE, 3).transpose(1, 0, 2, 3)


def _cells(columns: Sequence[Column], found: Sequence[dict]) -> list[str]:
    return [spread_text(column, [column.value(one) for one in found]) if found else "-" for column in columns]
