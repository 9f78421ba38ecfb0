"""The studio as a process, for scripts that look at its page."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


@contextmanager
def served(target: Path | str, work: Path, *options: str) -> Iterator[str]:
    """The address of a studio that is started on a scene, mesh file or run, and ends with the block."""
    command = [sys.executable, "-m", "fd_mitsuba", "studio", str(target), "--port", "0", "-o", str(work), *options]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert server.stdout is not None
        lines = iter(server.stdout.readline, "")
        found = next((match for line in lines if (match := re.search(r"http://\S+(?=,)", line))), None)
        assert found is not None, "the studio did not start"
        yield found[0]
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def driven(script: str, *arguments: object, options: dict[str, Any]) -> Any:
    """What a script of tools/viewers prints as JSON."""
    path = ROOT / "tools" / "viewers" / script
    command = ["node", str(path), *map(str, arguments), json.dumps(options)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def on_screen(point: np.ndarray, width: int, height: int) -> tuple[float, float]:
    """Pixel of a point (3,) of the canonical frame, seen by the page's first camera."""
    from fd_mitsuba.studio.canvas import CAMERA, FOV_DEG

    eye = np.array(CAMERA)
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    away = point - eye
    reach = height / 2 / np.tan(np.radians(FOV_DEG) / 2) / -(away @ back)
    return width / 2 + reach * (away @ right), height / 2 - reach * (away @ np.cross(back, right))


def upward_drag(centre: np.ndarray, distance: float, width: int, height: int) -> list[tuple[float, float]]:
    """Pixels where the mouse takes the upward arrow of a gizmo at `centre` (3,), and where it has moved it so far up;
    canonical units."""
    from fd_mitsuba.studio.canvas import GIZMO_SCALE

    tip = centre + [0.0, 0.8 * GIZMO_SCALE, 0.0]
    return [on_screen(place, width, height) for place in (tip, tip + [0.0, distance, 0.0])]
