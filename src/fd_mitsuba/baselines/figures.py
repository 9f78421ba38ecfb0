"""The figures of a comparison: scenes by methods, and the editors of single images with their consistency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from fd_mitsuba.baselines.jobs import JobOutcome, views_of
from fd_mitsuba.io.picture import write_picture

_TILE, _LINE, _MARGIN, _FONT = 160, 18, 6, 12
_SHOWN = 24
"""A pixel that differs by more from its view's corner, of 255, shows something."""
_DARK, _LIGHT = (24, 24, 24), (235, 235, 235)
SEEN_AT = (1 / 12, 7 / 12)
"""Two of a ring's views, as shares of a turn: three quarters from the front, and three quarters from behind."""
SEEN_2D_AT = (0.0, 1 / 4, 7 / 12)
"""Three views for the figure of the editors of single images."""


def write_comparison(outcomes: Sequence[JobOutcome], path: Path) -> None:
    """A PNG: a row for each scene, a column for the base and each method, two views below each other.

    Of the first seed. All views of a row are cut to what any of them shows.
    """
    scenes = list(dict.fromkeys(outcome.job.scene_name for outcome in outcomes))
    columns = ["base", *dict.fromkeys(outcome.job.method.kind for outcome in outcomes)]
    shown: dict[str, dict[str, np.ndarray]] = {scene: {} for scene in scenes}
    for outcome in outcomes:
        row, method = shown[outcome.job.scene_name], outcome.job.method.kind
        if outcome.result is not None and method not in row:
            base, row[method] = (_chosen(views, SEEN_AT) for views in views_of(outcome.job.folder))
            row.setdefault("base", base)
    if not any(shown.values()):
        return
    prompts = {outcome.job.scene_name: outcome.job.scene.prompt for outcome in outcomes}
    height = _LINE + len(SEEN_AT) * _TILE
    sheet, draw = _blank(_TILE * len(columns), _LINE + len(scenes) * height)
    for column, method in enumerate(columns):
        _write(draw, column * _TILE + _MARGIN, 2, method)
    for number, (scene, row) in enumerate(shown.items()):
        top = _LINE + number * height
        _write(draw, _MARGIN, top + 2, f"{scene}: {prompts[scene]}")
        window = _window(list(row.values()))
        for column, method in enumerate(columns):
            for place, view in enumerate(_tiles(row[method], window) if method in row else ()):
                sheet.paste(Image.fromarray(view), (column * _TILE, top + _LINE + place * _TILE))
    write_picture(path, sheet)


def write_views(outcomes: Sequence[JobOutcome], titles: Mapping[str, str], path: Path) -> None:
    """A PNG: a row for each result of the methods that `titles` names, three views, and under them their consistency.

    Args:
        titles: method -> what it is called in the figure.
    """
    first: dict[tuple[str, str], JobOutcome] = {}
    for outcome in outcomes:
        if outcome.result is not None and outcome.job.method.kind in titles:
            first.setdefault((outcome.job.scene_name, outcome.job.method.kind), outcome)
    if not first:
        return
    height, width = _TILE + 2 * _LINE, 2 * len(SEEN_2D_AT) * _TILE
    sheet, draw = _blank(width, len(first) * height)
    for row, ((scene, method), outcome) in enumerate(first.items()):
        base, edited = views_of(outcome.job.folder)
        views = [_chosen(found, SEEN_2D_AT) for found in (base, edited)]
        strip = np.concatenate([tile for found in views for tile in _tiles(found, _window(views))], axis=1)
        top = row * height
        _write(draw, _MARGIN, top + 2, f"{scene}, {titles[method]}: {outcome.job.scene.prompt}")
        sheet.paste(Image.fromarray(strip), (0, top + _LINE))
        assert outcome.result is not None
        share = outcome.result["consistency"]["explained"]
        said = "nothing new is seen" if share is None else f"{share:.0%} of what is new is explained by the other views"
        _write(draw, _MARGIN, top + _LINE + _TILE + 2, f"before, after; view consistency: {said}")
    write_picture(path, sheet)


def _chosen(views: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """(n, S, S, 3) of a ring (N, S, S, 3)."""
    return views[[round(share * len(views)) % len(views) for share in shares]]


def _window(views: Sequence[np.ndarray]) -> tuple[int, int, int, int]:
    """The smallest square (left, top, right, bottom) that holds what any of the views (n, S, S, 3) shows."""
    if not views:
        return 0, 0, 1, 1
    every = np.concatenate(list(views)).astype(np.int16)
    size = every.shape[1]
    row, column = np.nonzero((np.abs(every - every[:, :1, :1]).max(axis=3) > _SHOWN).any(axis=0))
    if not len(row):
        return 0, 0, size, size
    side = min(size, max(np.ptp(row), np.ptp(column)) + 1 + size // 12)
    left, top = (int(np.clip((found.min() + found.max() + 1 - side) // 2, 0, size - side)) for found in (column, row))
    return left, top, left + int(side), top + int(side)


def _tiles(views: np.ndarray, window: tuple[int, int, int, int]) -> list[np.ndarray]:
    """The window of views (n, S, S, 3), each (tile, tile, 3)."""
    how = Image.Resampling.LANCZOS
    return [np.asarray(Image.fromarray(view).crop(window).resize((_TILE, _TILE), how)) for view in views]


def _blank(width: int, height: int) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    sheet = Image.new("RGB", (width, height), _DARK)
    return sheet, ImageDraw.Draw(sheet)


def _write(draw: ImageDraw.ImageDraw, left: int, top: int, text: str) -> None:
    draw.text((left, top), text, fill=_LIGHT, font_size=_FONT)
