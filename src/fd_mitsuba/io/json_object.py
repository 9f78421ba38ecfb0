"""JSON files that hold one object."""

from __future__ import annotations

import json
import math
import stat
from pathlib import Path
from typing import Any

from fd_mitsuba.errors import first_line
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


def json_fault(path: Path) -> str:
    """What keeps `read_json_object` from a file, and where, for a line to people; "" where nothing does.

    Example: "line 3, column 12: Expecting ',' delimiter", "line 2: byte 0xe9 is not UTF-8".
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            return "no regular file"
        if about.st_size > _MOST_BYTES:
            return f"larger than {_MOST_BYTES >> 20} MB"
        data = path.read_bytes()
        parsed = json.loads(data.decode("utf-8"), parse_constant=lambda _: None, parse_float=_finite, parse_int=_whole)
    except OSError as error:
        return first_line(error)
    except RecursionError:
        return f"nested deeper than {_DEEPEST}"
    except ValueError as error:
        return syntax_fault(error)
    if not isinstance(parsed, dict):
        return "line 1: no object {...}"
    return f"nested deeper than {_DEEPEST}" if _deeper(parsed, _DEEPEST) else ""


def syntax_fault(error: ValueError) -> str:
    """Where and why a text is no JSON, from what decoding or parsing it raised."""
    if isinstance(error, UnicodeDecodeError):
        line = error.object[: error.start].count(b"\n") + 1
        return f"line {line}: byte 0x{error.object[error.start]:02x} is not UTF-8"
    if isinstance(error, json.JSONDecodeError):
        return f"line {error.lineno}, column {error.colno}: {error.msg}"
    return first_line(error)


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
