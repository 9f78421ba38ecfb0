"""The sheet of a preview: its views with captions and marks, and in the file how its pixels lie in the scene."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.picture_rays import PIXELS_KEY
from fd_mitsuba.viewing.preview_marks import BELOW, INK, LEFT, draw_axes, draw_grid_box, draw_scale_bar
from fd_mitsuba.viewing.preview_views import ParallelView

MARGIN = 14
_CAPTION = 20


def write_sheet(
    path: Path,
    scene: EditScene,
    views: Sequence[ParallelView],
    tiles: Sequence[Image.Image],
    colours: Sequence[tuple[float, float, float]],
) -> None:
    """Write the sheet as a PNG; UserError where that cannot be done.

    Its text `fd_mitsuba` tells where in the scene each pixel of a view looks; see `scene.picture_rays`.
    """
    size = tiles[0].width
    columns = min(len(tiles), 4)
    rows = -(-len(tiles) // columns)
    text, small = ImageFont.load_default(size=18), ImageFont.load_default(size=12)
    cell = (LEFT + size + MARGIN, _CAPTION + size + BELOW + MARGIN)
    width = columns * cell[0] + MARGIN
    probe = ImageDraw.Draw(Image.new("RGB", (8, 8)))
    legend = _legend_rows(probe, scene, small, width - 2 * MARGIN)
    header = MARGIN + 26 + 20 * (len(legend) + 1) + 6
    sheet = Image.new("RGB", (width, header + rows * cell[1]), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN - 2), _fitted(probe, scene.prompt, text, width - 2 * MARGIN), fill=INK, font=text)
    draw.text((MARGIN, MARGIN + 26), _fitted(probe, _box_line(scene), small, width - 2 * MARGIN), fill=INK, font=small)
    for row, entries in enumerate(legend):
        for x, index, label in entries:
            y = MARGIN + 46 + 20 * row
            swatch = tuple(int(255 * value) for value in colours[index])
            draw.ellipse((MARGIN + x, y + 2, MARGIN + x + 11, y + 13), fill=swatch)
            draw.text((MARGIN + x + 17, y), label, fill=INK, font=small)
    pixels = []
    for index, (view, tile) in enumerate(zip(views, tiles, strict=True)):
        place = (LEFT + index % columns * cell[0] + MARGIN // 2, header + index // columns * cell[1] + _CAPTION)
        marked = tile.copy()
        draw_grid_box(marked, view)
        sheet.paste(marked, place)
        draw.text((place[0], place[1] - 17), view.name, fill=INK, font=small)
        draw_axes(draw, view, scene.frame, place, size, small)
        draw_scale_bar(draw, view, scene.frame, place, size, small)
        pixels.append(_pixels_of(view, scene, place, size))
    info = PngInfo()
    info.add_text(PIXELS_KEY, json.dumps({"views": pixels}))
    stream = io.BytesIO()
    sheet.save(stream, format="PNG", pnginfo=info)
    try:
        write_atomically(path, stream.getvalue())
    except UserError:
        raise UserError(f"{path}: cannot be written; give another folder with -o") from None


def _pixels_of(view: ParallelView, scene: EditScene, place: tuple[int, int], size: int) -> dict[str, Any]:
    half = view.half / scene.frame.scale
    axes = {name: getattr(view, name).tolist() for name in ("right", "up", "back")}
    centre = scene.frame.to_user(view.centre).tolist()
    return {"name": view.name, "left": place[0], "top": place[1], "size": size, "half": half, "centre": centre, **axes}


def _box_line(scene: EditScene) -> str:
    low, high = scene.base_box
    ranges = ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
    return f"base {ranges} (scene units); dashed: the grid, in which a part can grow"


def _fitted(draw: ImageDraw.ImageDraw, text: str, font: Any, width: float) -> str:
    """The text, cut with three dots where it is wider than `width` pixels."""
    if draw.textlength(text, font=font) <= width:
        return text
    while text and draw.textlength(text + "...", font=font) > width:
        text = text[:-1]
    return text.rstrip() + "..."


def _legend_rows(
    draw: ImageDraw.ImageDraw, scene: EditScene, font: Any, width: float
) -> list[list[tuple[float, int, str]]]:
    """Rows of (x offset, region index, label), as many as fit beside each other."""
    rows: list[list[tuple[float, int, str]]] = [[]] if scene.regions else []
    x = 0.0
    for index, region in enumerate(scene.regions):
        label = _fitted(draw, f"{region.name} (part: {region.part})", font, width - 24)
        needed = 17 + draw.textlength(label, font=font) + 24
        if x and x + needed > width:
            rows.append([])
            x = 0.0
        rows[-1].append((x, index, label))
        x += needed
    return rows
