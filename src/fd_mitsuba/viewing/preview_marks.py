"""What is drawn over the views of a preview: the grid's box, axes with numbers in the scene's unit, a scale bar."""

from __future__ import annotations

from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.viewing.preview_views import ParallelView

INK, FAINT = (38, 40, 44), (150, 152, 158)
AXIS_INK = {"x": (196, 52, 44), "y": (44, 140, 60), "z": (48, 88, 200)}
LEFT, BELOW = 46, 36
"""Pixels beside and below a picture for the numbers of its axes."""
_DASH = 4


def draw_grid_box(tile: Image.Image, view: ParallelView) -> None:
    """The cube in which a part can grow, as a dashed outline."""
    draw, size = ImageDraw.Draw(tile), tile.width
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    corners = view.project(signs * GRID_HALF_EXTENT, size)
    for i in range(8):
        for j in range(i + 1, 8):
            if np.abs(signs[i] - signs[j]).sum() == 2:
                _dashed(draw, corners[i], corners[j])


def draw_axes(
    draw: ImageDraw.ImageDraw, view: ParallelView, frame: Normalisation, place: tuple[int, int], size: int, font: Any
) -> None:
    """Numbers along the left and lower edge of a picture at `place`; where the view is slanted, three arrows."""
    x0, y0 = place
    if not view.is_along_an_axis:
        _arrows(draw, view, (x0 + 26, y0 + size - 26), font)
        return
    for direction, along_x in ((view.right, True), (view.up, False)):
        axis = int(np.argmax(np.abs(direction)))
        sign = float(np.sign(direction[axis]))
        middle = float(frame.to_user(view.centre)[axis])
        half = view.half / frame.scale
        step = nice_step(2 * half / 5)
        for number in range(int(np.ceil((middle - half) / step)), int(np.floor((middle + half) / step)) + 1):
            share = (sign * (number * step - middle) / half + 1) / 2
            text = f"{number * step:.6g}"
            if along_x:
                x = x0 + share * size
                draw.line((x, y0 + size, x, y0 + size + 4), fill=FAINT)
                draw.text((x, y0 + size + 5), text, fill=INK, font=font, anchor="ma")
            else:
                y = y0 + (1 - share) * size
                draw.line((x0 - 4, y, x0, y), fill=FAINT)
                draw.text((x0 - 6, y), text, fill=INK, font=font, anchor="rm")
        name = "xyz"[axis]
        spot = (x0 + size, y0 + size + 20) if along_x else (x0 - LEFT + 2, y0)
        draw.text(spot, name, fill=AXIS_INK[name], font=font, anchor="ra" if along_x else "la")


def draw_scale_bar(
    draw: ImageDraw.ImageDraw, view: ParallelView, frame: Normalisation, place: tuple[int, int], size: int, font: Any
) -> None:
    """A bar of a round length, with the length in the scene's unit, right of the caption below a picture."""
    length = nice_step(view.half / frame.scale / 2)
    pixels = length * frame.scale / (2 * view.half) * size
    x1, y = place[0] + size - 16, place[1] + size + BELOW - 9
    draw.line((x1 - pixels, y, x1, y), fill=INK, width=2)
    for x in (x1 - pixels, x1):
        draw.line((x, y - 3, x, y + 3), fill=INK)
    draw.text((x1 - pixels - 5, y), f"{length:.6g}", fill=INK, font=font, anchor="rm")


def nice_step(length: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(factor * power for factor in (5, 2, 1) if factor * power <= length * (1 + 1e-9)))


def _arrows(draw: ImageDraw.ImageDraw, view: ParallelView, origin: tuple[float, float], font: Any) -> None:
    for name, axis in zip("xyz", np.eye(3), strict=True):
        dx, dy = 20 * float(axis @ view.right), -20 * float(axis @ view.up)
        draw.line((*origin, origin[0] + dx, origin[1] + dy), fill=AXIS_INK[name], width=2)
        draw.text((origin[0] + 1.35 * dx, origin[1] + 1.35 * dy), name, fill=AXIS_INK[name], font=font, anchor="mm")


def _dashed(draw: ImageDraw.ImageDraw, start: np.ndarray, end: np.ndarray) -> None:
    length = float(np.linalg.norm(end - start))
    for dash in np.arange(0, length, 2 * _DASH):
        one = start + (end - start) * (dash / length)
        two = start + (end - start) * (min(dash + _DASH, length) / length)
        draw.line((*one, *two), fill=FAINT)
