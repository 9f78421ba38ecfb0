"""JSON files that hold one object."""

from __future__ import annotations

import json
from pathlib import Path

from fd_mitsuba.io.atomic import write_atomically


def read_json_object(path: Path) -> dict | None:
    """The object in a JSON file; None where there is no such file, or none that can be read."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None


def write_json(path: Path, data: dict) -> None:
    """Write indented JSON, whole or not at all; UserError if the folder cannot be written."""
    write_atomically(path, (json.dumps(data, indent=2) + "\n").encode())
