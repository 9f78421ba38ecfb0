"""Turntables as film strips: all frames of one in a single picture inside a page, which a page turns by itself."""

from __future__ import annotations

import base64
import io
import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from PIL import Image

from fd_mitsuba.config.bounds import MOST_TURNTABLE_PIXELS

MOST_FRAMES = 48
_CAPTION, _SHEET_VIEWS = 18, 8  # as `turntable.write_sheet` and its callers have them
_NOISE = 14  # what a video's codec may do to a flat background
_QUALITY = 84
_MOST_PIXELS = MOST_TURNTABLE_PIXELS
_MOST_PICTURE_PIXELS = 1 << 26


@dataclass(frozen=True)
class Strip:
    """Frames side by side, in rows of `columns`."""

    uri: str
    """A WebP picture as a data URI."""
    count: int
    columns: int
    rows: int
    aspect: float
    """Width over height of a frame."""
    background: str
    """CSS colour of the frames' corner."""


def video_frames(path: Path) -> np.ndarray | None:
    """At most `MOST_FRAMES` frames (count, height, width, 3) uint8, evenly spaced; None if it cannot be read."""
    if not path.is_file():
        return None
    frames, pixels = [], 0
    try:
        with imageio.imopen(path, "r", plugin="pyav") as video:
            for frame in video.iter():
                pixels += frame.shape[0] * frame.shape[1]
                if pixels > _MOST_PIXELS or (frames and frame.shape != frames[0].shape):
                    return None
                frames.append(frame)
    except Exception:  # the decoders raise errors of a dozen kinds at a damaged file
        return None
    return np.stack(frames[:: math.ceil(len(frames) / MOST_FRAMES)]) if frames else None


def read_picture(path: Path) -> Image.Image | None:
    """The decoded picture; None where there is none, or none that can be read, or one of too many pixels."""
    if not path.is_file():
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                if image.width * image.height > _MOST_PICTURE_PIXELS:
                    return None
                image.load()
                return image
    except Exception:  # as above
        return None


def sheet_row(path: Path, row: int) -> np.ndarray | None:
    """The eight frames of one row of a contact sheet of `turntable.write_sheet`; None if there is no such row."""
    sheet = read_picture(path)
    if sheet is None:
        return None
    pixels = np.asarray(sheet.convert("RGB"))
    size = pixels.shape[1] // _SHEET_VIEWS
    top = row * (size + _CAPTION) + _CAPTION
    if size == 0 or top + size > len(pixels):
        return None
    line = pixels[top : top + size, : size * _SHEET_VIEWS]
    return line.reshape(size, _SHEET_VIEWS, size, 3).swapaxes(0, 1)


def common_crop(*films: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold all that is seen in any frame of films of one size, with a margin."""
    height, width = films[0].shape[1:3]
    seen = np.zeros((height, width), bool)
    for frames in films:
        corner = frames[:, :1, :1].astype(np.int16)
        seen |= (np.abs(frames.astype(np.int16) - corner) > _NOISE).any(axis=(0, 3))
    if not seen.any():
        return slice(0, height), slice(0, width)
    bounds = []
    for axis, length in ((1, height), (0, width)):
        inside = np.flatnonzero(seen.any(axis=axis))
        margin = max(2, round(0.04 * length))
        bounds.append(slice(max(0, inside[0] - margin), min(length, inside[-1] + 1 + margin)))
    return bounds[0], bounds[1]


def strip(frames: np.ndarray, crop: tuple[slice, slice] | None = None, size: int | None = None) -> Strip:
    """The strip of frames (count, height, width, 3) uint8.

    Args:
        crop: see `common_crop`; None: all of each frame.
        size: longest side of a frame in pixels, if smaller than it is.
    """
    if crop is not None:
        frames = frames[:, crop[0], crop[1]]
    if size is not None and max(frames.shape[1:3]) > size:
        scale = size / max(frames.shape[1:3])
        shape = max(1, round(frames.shape[2] * scale)), max(1, round(frames.shape[1] * scale))
        frames = np.stack([np.asarray(Image.fromarray(f).resize(shape, Image.Resampling.LANCZOS)) for f in frames])
    count, height, width = frames.shape[:3]
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    grid = np.zeros((rows * height, columns * width, 3), np.uint8)
    for index, frame in enumerate(frames):
        y, x = divmod(index, columns)
        grid[y * height : (y + 1) * height, x * width : (x + 1) * width] = frame
    corner = ", ".join(str(int(value)) for value in frames[0, 0, 0])
    return Strip(picture_uri(Image.fromarray(grid)), count, columns, rows, width / height, f"rgb({corner})")


def picture_uri(image: Image.Image, widest: int | None = None) -> str:
    """The picture as a WebP data URI, not wider than `widest` pixels."""
    if widest is not None and image.width > widest:
        image = image.resize((widest, max(1, round(image.height * widest / image.width))), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    image.convert("RGB").save(data, format="WEBP", quality=_QUALITY, method=4)
    return f"data:image/webp;base64,{base64.b64encode(data.getvalue()).decode()}"
