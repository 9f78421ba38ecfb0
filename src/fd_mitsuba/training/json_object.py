"""What `training.run_folder.write_json` has written, read back; without torch, which a waiting batch does not load."""

from __future__ import annotations

import json
from pathlib import Path


def read_json_object(path: Path) -> dict | None:
    """The object in a JSON file; None where there is no such file, or none that can be read."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None
