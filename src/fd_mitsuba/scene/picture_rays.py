"""Where a pixel of a preview looks in the scene: what a preview's file says about itself, read back with care."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
from PIL import Image

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.regular_file import NotReadable, read_regular

PIXELS_KEY = "fd_mitsuba"
"""Of the PNG's text that holds a list of views: place and size in pixels, and axes, centre and half width in the
scene's frame and unit."""
_WORDS = re.compile(r"pixel (\d{1,5})[ ,]+(\d{1,5}) of (.+)")
_MOST_BYTES = 1 << 27


def pixel_ray(text: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Origin (3,) and unit direction (3,) of the ray that "pixel X Y of FILE" means; None for any other text.

    Raises:
        UserError: a file that is no preview, a pixel beside its views.
    """
    found = _WORDS.fullmatch(" ".join(text.split()))
    if found is None:
        return None
    x, y, path = int(found[1]), int(found[2]), Path(found[3])
    for view in _views(path):
        across = 2 * (x + 0.5 - view["left"]) / view["size"] - 1
        down = 2 * (y + 0.5 - view["top"]) / view["size"] - 1
        if max(abs(across), abs(down)) <= 1:
            right, up, back, centre = (np.array(view[key]) for key in ("right", "up", "back", "centre"))
            return centre + view["half"] * (across * right - down * up + 100 * back), -back
    raise UserError(f"{path}: pixel {x} {y} lies beside its views; take one of the object itself")


def _views(path: Path) -> list[dict]:
    try:
        data = read_regular(path, _MOST_BYTES)
        image = Image.open(io.BytesIO(data), formats=("PNG",))
        views = json.loads(image.info[PIXELS_KEY])["views"]
        numbers = [[view["left"], view["top"], view["size"], view["half"]] for view in views]
        axes = [[view[key] for key in ("right", "up", "back", "centre")] for view in views]
        table = np.array(numbers, dtype=np.float64)
        sound = np.isfinite(table).all() and (table[:, 2:] > 0).all()
        if not sound or np.array(axes, dtype=np.float64).shape[1:] != (4, 3):
            raise ValueError
    except NotReadable as error:
        raise UserError(f"{path}: {error}") from None
    except (OSError, KeyError, TypeError, ValueError, RecursionError, SyntaxError):
        raise UserError(f"{path}: is no preview that fd_mitsuba has made; make one with fd_mitsuba preview") from None
    return views
