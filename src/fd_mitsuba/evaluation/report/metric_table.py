"""Figures of JSON files as tables for people: a table for each group, a row for each value."""

from __future__ import annotations

import math
from dataclasses import dataclass

_SHARES = {"inside_fraction", "overlap_fraction", "untouched_share", "leakage", "overlap"}


@dataclass(frozen=True)
class Row:
    """Attributes:
    name: `group.key` as in the file, or `key` alone in the group `run`.
    number: to be set flush right.
    """

    name: str
    title: str
    text: str
    number: bool


@dataclass(frozen=True)
class FigureTable:
    """A titled group of rows; `settings` where they are a run's settings."""

    title: str
    rows: list[Row]
    settings: bool = False


def figure_tables(data: dict, title: str, settings: bool = False) -> list[FigureTable]:
    """The values of `data` itself as one table, and each dictionary in it as another, at any depth."""
    rows, inner = [], []
    for key, value in data.items():
        if isinstance(value, dict) and value:
            inner += figure_tables(value, str(key), settings)
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            for number, item in enumerate(value, 1):
                inner += figure_tables(item, f"{key} {number}", settings)
        else:
            number = isinstance(value, int | float) and not isinstance(value, bool)
            rows.append(
                Row(
                    f"{title}.{key}" if title != "run" else str(key),
                    str(key).replace("_", " "),
                    text_of(value, str(key)),
                    number,
                )
            )
    own = [FigureTable(title.replace("_", " "), rows, settings)] if rows else []
    return own + inner


def text_of(value: object, key: str = "") -> str:
    """A value as people read it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:.2%}" if key in _SHARES else f"{value:.5g}"
    if isinstance(value, list | tuple):
        return ", ".join(text_of(item) for item in value)
    return str(value)


def duration(seconds: float) -> str:
    """`42 s`, `3 min 5 s`, `2 h 10 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
