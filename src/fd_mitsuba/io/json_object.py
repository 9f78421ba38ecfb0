"""JSON files that hold one object."""

from __future__ import annotations

import json
import math
import stat
from pathlib import Path
from typing import Any

from fd_mitsuba.io.atomic import write_atomically

_MOST_BYTES = 1 << 26
_DEEPEST = 32
_MOST_DIGITS = 18


def read_json_object(path: Path) -> dict | None:
    """The object in a JSON file; None where there is no such file, or none that can be read.

    Numbers that are not finite, or whole and of more than 18 digits, are read as None: nothing here writes them, and
    sums and charts break on them.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode) or about.st_size > _MOST_BYTES:
            return None
        return parse_json_object(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def parse_json_object(text: str) -> dict | None:
    """The object in a JSON text, as `read_json_object`; None where there is none."""
    try:
        data = json.loads(text, parse_constant=lambda _: None, parse_float=_finite, parse_int=_whole)
    except (ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) and not _deeper(data, _DEEPEST) else None


def write_json(path: Path, data: dict) -> None:
    """Write indented JSON, whole or not at all; UserError if the folder cannot be written."""
    write_atomically(path, (json.dumps(data, indent=2) + "\n").encode())


def _whole(text: str) -> int | None:
    return int(text) if len(text) <= _MOST_DIGITS else None


def _finite(text: str) -> float | None:
    number = float(text)
    return number if math.isfinite(number) else None


def _deeper(data: Any, most: int) -> bool:
    """Whether lists and objects are nested deeper than `most`."""
    layer = [data]
    for _ in range(most + 1):
        layer = [
            inner
            for outer in layer
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
        if not layer:
            return False
    return True
