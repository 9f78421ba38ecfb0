"""Pictures as files."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from fd_mitsuba.io.atomic import write_atomically


def write_picture(path: Path, image: Image.Image) -> None:
    """Write a PNG, whole or not at all; UserError if the folder cannot be written."""
    data = io.BytesIO()
    image.save(data, format="PNG", compress_level=4)  # twice as fast as the default, for a twentieth more bytes
    write_atomically(path, data.getvalue())
