"""Pictures of a scene before a run: the base from named sides with its focal regions drawn as coloured glass."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fd_mitsuba.backend import startup
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.scene_file import ready_mitsuba
from fd_mitsuba.viewing.preview_sheet import write_sheet
from fd_mitsuba.viewing.preview_views import VIEW_NAMES, ParallelView, preview_views

SIZE = 320
_SPP = 36
"""A square, as the stratified sampler wants it; that sampler has a third of the noise of independent samples."""
_PAPER = np.array([0.965, 0.965, 0.96])


def preview_scene(
    scene: EditScene, out_dir: Path | str, views: Sequence[str] = VIEW_NAMES, size: int = SIZE
) -> list[Path]:
    """Write `preview.png`, a sheet of named views, into `out_dir` and return its path in a list.

    The base is path-traced with its own BSDFs under the scene's own light (a neutral lamp where there is none), exposed
    to fit. Regions are see-through: brighter at their rim, faint where the base hides them. The grid is dashed; axes
    and scale bars are in the scene's unit. The scene need not have regions.

    Args:
        views: of `preview_views.VIEW_NAMES`.
        size: pixels a side of one view.

    Raises:
        UserError: `out_dir` cannot be written.
    """
    cube = GRID_HALF_EXTENT * np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    signs = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    chosen = preview_views(tuple(views), cube[signs, np.arange(3)])
    colours = region_colours(len(scene.regions))
    pictures, depth = _base_pictures(scene, chosen, size)
    for region, colour in zip(scene.regions, colours, strict=True):
        pictures = _with_region(pictures, depth, region, np.array(colour), chosen, size)
    path = Path(out_dir) / "preview.png"
    write_sheet(path, scene, chosen, [_shrunk(picture, size) for picture in pictures], colours)
    return [path]


def region_colours(count: int) -> list[tuple[float, float, float]]:
    """`count` sRGB colours that are easy to tell apart, orange first."""
    golden = 0.618034
    return [colorsys.hsv_to_rgb((0.07 + i * golden) % 1.0, 0.85, 0.95) for i in range(count)]


def _base_pictures(scene: EditScene, views: Sequence[ParallelView], size: int) -> tuple[np.ndarray, np.ndarray]:
    """sRGB pictures (B, 2 size, 2 size, 3) in [0, 1] on paper, and the base's distance (canonical units)."""
    mi = scene.inputs.scene.mi
    loaded = scene.mitsuba_scene(without=("focal_region", "sensor", "integrator"))
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    radiance, cover = [], []
    for index, view in enumerate(views):
        content = loaded if scene.has_light else _lit(mi, loaded, view)
        sensor = view.sensor(mi, scene.render_frame.to_user, size)
        pixels = np.array(mi.render(content, sensor=sensor, integrator=integrator, spp=_SPP, seed=index))
        radiance.append(pixels[..., :3])
        cover.append(np.clip(pixels[..., 3:4], 0, 1))
    colour, alpha = np.nan_to_num(np.stack(radiance)), np.stack(cover)
    solid = colour[alpha[..., 0] > 0.9]
    exposure = 0.75 / max(float(np.percentile(solid.max(axis=1), 90)), 1e-6) if len(solid) else 1.0
    # hide_emitters leaves the colour multiplied by its coverage
    blend = _srgb(np.clip(colour * exposure / np.maximum(alpha, 1e-3), 0, 1)) * alpha + _PAPER * (1 - alpha)
    blend = blend.repeat(2, axis=1).repeat(2, axis=2)  # twice the pixels, to smooth the regions' outlines
    depth = np.stack([_hit(mi, loaded, view, 2 * size, scene)[0] for view in views])
    return blend, depth


def _lit(mi: Any, loaded: Any, view: ParallelView) -> Any:
    """The scene with a lamp over the camera's left shoulder and some light from everywhere."""
    lamp = {"type": "directional", "direction": list(0.5 * view.right - 0.9 * view.up - view.back), "irradiance": 2.0}
    shapes = {f"shape_{number}": shape for number, shape in enumerate(loaded.shapes())}
    return mi.load_dict(
        {"type": "scene", "lamp": lamp, "sky": {"type": "constant", "radiance": 0.35}, **shapes}, optimize=False
    )


def _hit(
    mi: Any, loaded: Any, view: ParallelView, pixels: int, scene: EditScene | None
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (P, P) to the first surface in canonical units, inf where there is none, and its normal (P, P, 3).

    Args:
        scene: whose frame `loaded` is in; None: the canonical one.
    """
    origins, direction = view.rays(pixels)
    scale = 1.0
    if scene is not None:
        origins, scale = scene.render_frame.to_user(origins), scene.frame.scale
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(origins.T, dtype=np.float32)), mi.Vector3f(*direction.tolist()))
    surface = loaded.ray_intersect(ray)
    valid = np.array(surface.is_valid()).reshape(pixels, pixels)
    distance = np.where(valid, np.array(surface.t).reshape(pixels, pixels) * scale, np.inf)
    return distance, np.array(surface.sh_frame.n).T.reshape(pixels, pixels, 3)


def _with_region(
    pictures: np.ndarray,
    base: np.ndarray,
    region: FocalRegion,
    colour: np.ndarray,
    views: Sequence[ParallelView],
    size: int,
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
    for index, view in enumerate(views):
        distance, normal = _hit(mi, alone, view, 2 * size, None)
        facing = np.abs(normal @ view.back)
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
