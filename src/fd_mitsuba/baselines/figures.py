"""The figures of a comparison: scenes by methods, and the editors of single images with their consistency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from fd_mitsuba.baselines.jobs import JobOutcome, views_of
from fd_mitsuba.io.picture import write_picture

_TILE, _LINE, _MARGIN = 160, 18, 6
_DARK, _LIGHT = (24, 24, 24), (235, 235, 235)
SEEN_AT = (1 / 12, 7 / 12)
"""Two of a ring's views, as shares of a turn: three quarters from the front, and three quarters from behind."""
SEEN_2D_AT = (0.0, 1 / 4, 7 / 12)
"""Three views for the figure of the editors of single images."""


def write_comparison(outcomes: Sequence[JobOutcome], path: Path) -> None:
    """A PNG: a row for each scene, a column for the base and each method, two views each; of the first seed."""
    scenes = list(dict.fromkeys(outcome.job.scene_name for outcome in outcomes))
    methods = list(dict.fromkeys(outcome.job.method.kind for outcome in outcomes))
    shown: dict[tuple[str, str], np.ndarray] = {}
    for outcome in outcomes:
        place = outcome.job.scene_name, outcome.job.method.kind
        if outcome.result is not None and place not in shown:
            base, edited = views_of(outcome.job.folder)
            shown[place] = _some(edited, SEEN_AT)
            shown.setdefault((outcome.job.scene_name, "base"), _some(base, SEEN_AT))
    if not shown:
        return
    columns = ["base", *methods]
    prompts = {outcome.job.scene_name: outcome.job.scene.prompt for outcome in outcomes}
    sheet, draw = _blank(len(SEEN_AT) * _TILE * len(columns), _LINE + len(scenes) * (_TILE + _LINE))
    for column, method in enumerate(columns):
        draw.text((column * len(SEEN_AT) * _TILE + _MARGIN, 3), method, fill=_LIGHT)
    for row, scene in enumerate(scenes):
        top = _LINE + row * (_TILE + _LINE)
        draw.text((_MARGIN, top + 3), f"{scene}: {prompts[scene]}", fill=_LIGHT)
        for column, method in enumerate(columns):
            if (scene, method) in shown:
                strip = np.concatenate(list(shown[scene, method]), axis=1)
                sheet.paste(Image.fromarray(strip), (column * len(SEEN_AT) * _TILE, top + _LINE))
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
        strip = np.concatenate([*_some(base, SEEN_2D_AT), *_some(edited, SEEN_2D_AT)], axis=1)
        top = row * height
        draw.text((_MARGIN, top + 3), f"{scene}, {titles[method]}: {outcome.job.scene.prompt}", fill=_LIGHT)
        sheet.paste(Image.fromarray(strip), (0, top + _LINE))
        assert outcome.result is not None
        share = outcome.result["consistency"]["explained"]
        said = "nothing new is seen" if share is None else f"{share:.0%} of what is new is explained by the other views"
        draw.text((_MARGIN, top + _LINE + _TILE + 3), f"before, after; view consistency: {said}", fill=_LIGHT)
    write_picture(path, sheet)


def _some(views: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """(n, tile, tile, 3) of a ring (N, S, S, 3)."""
    chosen = [Image.fromarray(views[round(share * len(views)) % len(views)]) for share in shares]
    return np.stack([np.asarray(view.resize((_TILE, _TILE), Image.Resampling.LANCZOS)) for view in chosen])


def _blank(width: int, height: int) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    sheet = Image.new("RGB", (width, height), _DARK)
    return sheet, ImageDraw.Draw(sheet)
