"""Pictures of a scene before a run: the base from all sides with its focal regions drawn as coloured glass."""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from fd_mitsuba.backend import startup
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.scene_file import SceneFile, ready_mitsuba
from fd_mitsuba.scene.views import CameraBatch, ring_views

VIEWS = 6
SIZE = 320
_SPP = 36
"""A square, as the stratified sampler wants it; that sampler has a third of the noise of independent samples."""
_PAPER = np.array([0.965, 0.965, 0.96])
_INK = (38, 40, 44)
_MARGIN = 16


def preview_scene(
    scene: EditScene, out_dir: Path | str, views: int = VIEWS, size: int = SIZE, elevation_deg: float = 20.0
) -> list[Path]:
    """Write `preview.png`, a contact sheet of `views` ring views, into `out_dir` and return its path in a list.

    The base is path-traced with its own BSDFs under the scene's own light (a neutral lamp where there is none), exposed
    to fit. Regions are see-through: brighter at their rim, faint where the base hides them.

    Args:
        size: pixels a side of one view.

    Raises:
        UserError: `out_dir` cannot be written.
    """
    cameras = ring_views(views, elevation_deg, fov_deg=45.0, radius=3.0)
    colours = region_colours(len(scene.regions))
    pictures, depth = _base_pictures(scene, cameras, size)
    for region, colour in zip(scene.regions, colours, strict=True):
        pictures = _with_region(pictures, depth, region, np.array(colour), cameras, size)
    tiles = [_shrunk(picture, size) for picture in pictures]
    path = Path(out_dir) / "preview.png"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _sheet(scene, cameras, tiles, colours, size).save(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error}); give another folder with -o") from None
    return [path]


def region_colours(count: int) -> list[tuple[float, float, float]]:
    """`count` sRGB colours that are easy to tell apart, orange first."""
    golden = 0.618034
    return [colorsys.hsv_to_rgb((0.07 + i * golden) % 1.0, 0.85, 0.95) for i in range(count)]


def _base_pictures(scene: EditScene, cameras: CameraBatch, size: int) -> tuple[np.ndarray, np.ndarray]:
    """sRGB pictures (B, 2 size, 2 size, 3) in [0, 1] on paper, and the base's distance (canonical units)."""
    file = SceneFile(scene.path, scene.parameters)
    mi = file.mi
    loaded = file.instantiate(without=("focal_region", "sensor", "integrator"), origin=scene.origin)
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    radiance, cover = [], []
    for index in range(len(cameras)):
        content = loaded if scene.has_light else _lit(mi, loaded, scene, cameras, index)
        sensor = _sensor(mi, scene, cameras, index, size)
        pixels = np.array(mi.render(content, sensor=sensor, integrator=integrator, spp=_SPP, seed=index))
        radiance.append(pixels[..., :3])
        cover.append(np.clip(pixels[..., 3:4], 0, 1))
    colour, alpha = np.nan_to_num(np.stack(radiance)), np.stack(cover)
    solid = colour[alpha[..., 0] > 0.9]
    exposure = 0.75 / max(float(np.percentile(solid.max(axis=1), 90)), 1e-6) if len(solid) else 1.0
    # hide_emitters leaves the colour multiplied by its coverage
    blend = _srgb(np.clip(colour * exposure / np.maximum(alpha, 1e-3), 0, 1)) * alpha + _PAPER * (1 - alpha)
    blend = blend.repeat(2, axis=1).repeat(2, axis=2)  # twice the pixels, to smooth the regions' outlines
    depth = np.stack([_hit(mi, loaded, cameras, i, 2 * size, scene)[0] for i in range(len(cameras))])
    return blend, depth


def _lit(mi: Any, loaded: Any, scene: EditScene, cameras: CameraBatch, index: int) -> Any:
    """The scene with a lamp over the camera's left shoulder and some light from everywhere."""
    right, up, back = (axis[index].astype(np.float64) for axis in cameras.basis())
    lamp = {"type": "directional", "direction": list(0.5 * right - 0.9 * up - back), "irradiance": 2.0}
    shapes = {f"shape_{number}": shape for number, shape in enumerate(loaded.shapes())}
    return mi.load_dict(
        {"type": "scene", "lamp": lamp, "sky": {"type": "constant", "radiance": 0.35}, **shapes}, optimize=False
    )


def _sensor(mi: Any, scene: EditScene, cameras: CameraBatch, index: int, size: int) -> Any:
    position, target = (scene.render_frame.to_user(point[index]) for point in (cameras.position, cameras.target))
    up = cameras.basis()[1][index]
    reach = 3.0 / scene.frame.scale
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(cameras.fov_deg[index]),
            "near_clip": 1e-3 * reach,
            "far_clip": 1e2 * reach,
            "to_world": mi.ScalarTransform4f().look_at(
                origin=position.tolist(), target=target.tolist(), up=up.tolist()
            ),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter"},
        }
    )


def _rays(cameras: CameraBatch, index: int, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (pixels^2, 3) through pixel centres, row 0 at the top, canonical frame."""
    right, up, back = (axis[index].astype(np.float64) for axis in cameras.basis())
    reach = np.tan(np.radians(cameras.fov_deg[index]) / 2)
    across = (2 * (np.arange(pixels) + 0.5) / pixels - 1) * reach
    x, y = np.meshgrid(across, -across)
    direction = x[..., None] * right + y[..., None] * up - back
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return cameras.position[index].astype(np.float64), direction.reshape(-1, 3)


def _hit(
    mi: Any, loaded: Any, cameras: CameraBatch, index: int, pixels: int, scene: EditScene | None
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (P, P) to the first surface in canonical units, inf where there is none, and its normal (P, P, 3)."""
    origin, direction = _rays(cameras, index, pixels)
    scale = 1.0
    if scene is not None:
        origin, scale = scene.render_frame.to_user(origin), scene.frame.scale
    ray = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(np.ascontiguousarray(direction.T, dtype=np.float32)))
    surface = loaded.ray_intersect(ray)
    valid = np.array(surface.is_valid()).reshape(pixels, pixels)
    distance = np.where(valid, np.array(surface.t).reshape(pixels, pixels) * scale, np.inf)
    return distance, np.array(surface.sh_frame.n).T.reshape(pixels, pixels, 3)


def _with_region(
    pictures: np.ndarray, base: np.ndarray, region: FocalRegion, colour: np.ndarray, cameras: CameraBatch, size: int
) -> np.ndarray:
    """The pictures with one region laid over them."""
    mi = ready_mitsuba()
    solid = region.surface(4)
    mesh = mi.Mesh(region.name, len(solid.vertices), len(solid.faces), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters[startup.VERTICES] = np.ascontiguousarray(solid.vertices.ravel(), dtype=np.float32)
    parameters[startup.FACES] = np.ascontiguousarray(solid.faces.ravel(), dtype=np.uint32)
    parameters.update()
    alone = mi.load_dict({"type": "scene", "region": mesh}, optimize=False)
    result = pictures.copy()
    for index in range(len(cameras)):
        distance, normal = _hit(mi, alone, cameras, index, 2 * size, None)
        _, direction = _rays(cameras, index, 2 * size)
        facing = np.abs(np.einsum("ijk,ijk->ij", normal, direction.reshape(2 * size, 2 * size, 3)))
        rim = (1 - np.clip(facing, 0, 1)) ** 2.5
        hit = np.isfinite(distance)
        front = distance <= base[index] + 1e-4
        # In front of the base it is glass; behind it, a hint of where it goes on.
        opacity = np.where(front, 0.34 + 0.5 * rim, 0.10 + 0.32 * rim) * hit
        shade = colour * (0.72 + 0.28 * facing[..., None])
        result[index] = result[index] * (1 - opacity[..., None]) + shade * opacity[..., None]
    return result


def _srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _shrunk(picture: np.ndarray, size: int) -> Image.Image:
    averaged = picture.reshape(size, 2, size, 2, 3).mean(axis=(1, 3))
    return Image.fromarray((np.clip(averaged, 0, 1) * 255 + 0.5).astype(np.uint8))


def _sheet(
    scene: EditScene,
    cameras: CameraBatch,
    tiles: list[Image.Image],
    colours: list[tuple[float, float, float]],
    size: int,
) -> Image.Image:
    columns = min(len(tiles), 3 if len(tiles) <= 6 else 4)
    rows = -(-len(tiles) // columns)
    text, small = ImageFont.load_default(size=18), ImageFont.load_default(size=13)
    width = columns * size + (columns + 1) * _MARGIN
    paper = tuple(int(value * 255) for value in _PAPER)
    draw_probe = ImageDraw.Draw(Image.new("RGB", (8, 8)))
    title = _fitted(draw_probe, scene.prompt, text, width - 2 * _MARGIN)
    legend = _legend_rows(draw_probe, scene, small, width - 2 * _MARGIN)
    header = _MARGIN + 26 + 22 * len(legend) + 10
    caption = 24
    sheet = Image.new("RGB", (width, header + rows * (size + caption + _MARGIN)), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((_MARGIN, _MARGIN - 2), title, fill=_INK, font=text)
    for row, entries in enumerate(legend):
        for x, index, label in entries:
            y = _MARGIN + 28 + 22 * row
            swatch = tuple(int(255 * value) for value in colours[index])
            draw.ellipse((_MARGIN + x, y + 2, _MARGIN + x + 12, y + 14), fill=swatch)
            draw.text((_MARGIN + x + 18, y), label, fill=_INK, font=small)
    for index, tile in enumerate(tiles):
        x = _MARGIN + index % columns * (size + _MARGIN)
        y = header + index // columns * (size + caption + _MARGIN)
        sheet.paste(paper, (x, y, x + size, y + size))
        sheet.paste(tile, (x, y))
        label = f"{cameras.labels()[index]}  azimuth {cameras.azimuth_deg[index]:.0f}°"
        draw.text((x + 2, y + size + 5), label, fill=_INK, font=small)
    return sheet


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
    rows: list[list[tuple[float, int, str]]] = [[]]
    x = 0.0
    for index, region in enumerate(scene.regions):
        label = _fitted(draw, f"{region.name} (part: {region.part})", font, width - 24)
        needed = 18 + draw.textlength(label, font=font) + 24
        if x and x + needed > width:
            rows.append([])
            x = 0.0
        rows[-1].append((x, index, label))
        x += needed
    return rows
