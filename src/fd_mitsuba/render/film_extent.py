"""Where on the film an object can be at all: the pixels within the outline of its convex hull.

Rays through all others are certain to miss, and in views of a whole object they are the most.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from fd_mitsuba.backend.startup import VERTICES
from fd_mitsuba.render.cameras import FilmCameras

_MARGIN = 1
"""Pixels around the outline, for rounding."""
_NEAREST_DEPTH = 1e-3
"""A hull that comes nearer to the camera's plane than this may be anywhere on the film."""


def hull_corners(scene: mi.Scene) -> np.ndarray:
    """(V, 3) float64: points whose convex hull holds every shape of a scene, in its frame."""
    points = [_corners(shape) for shape in scene.shapes()]
    every = np.concatenate(points) if points else np.zeros((0, 3))
    return _extreme(every)


def pixels_within(corners: np.ndarray, views: FilmCameras) -> np.ndarray:
    """(N,) int64, ascending: the pixels, numbered through all views, in which the hull of (V, 3) corners may be seen.

    Two at least, so that there is always something to trace.
    """
    size, found = views.size, [np.zeros(0, np.int64)]
    for view in range(views.count if len(corners) else 0):
        left, right = _columns(_film(corners, views, view), size)
        width = np.maximum(right - left, 0)
        begin = np.cumsum(width) - width
        within = np.arange(int(width.sum())) - np.repeat(begin, width)
        found.append(view * size**2 + np.repeat(np.arange(size) * size + left, width) + within)
    pixels = np.concatenate(found)
    return pixels if len(pixels) > 1 else np.arange(2)


def _corners(shape: mi.Shape) -> np.ndarray:
    if shape.is_mesh():
        return np.array(mi.traverse(shape)[VERTICES], dtype=np.float64).reshape(-1, 3)
    box = shape.bbox()
    return np.array([np.array(box.corner(number)) for number in range(8)], dtype=np.float64)


def _extreme(points: np.ndarray) -> np.ndarray:
    """Those of the points that are corners of their hull; all of them where that cannot be said."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # flat, or too few
        return points


def _film(corners: np.ndarray, views: FilmCameras, view: int) -> np.ndarray | None:
    """(V, 2) film positions; None where a corner is beside or behind the camera."""
    right, up, back = views.axes[view]
    offset = corners - views.position[view]
    depth = -(offset @ back)
    if not (depth > _NEAREST_DEPTH).all():
        return None
    scale, centre = 0.5 * views.size / (depth * views.half_width[view]), 0.5 * views.size
    return np.stack([centre + (offset @ right) * scale, centre - (offset @ up) * scale], axis=1)


def _columns(film: np.ndarray | None, size: int) -> tuple[np.ndarray, np.ndarray]:
    """First column, and the one behind the last, of the hull in each of `size` rows; each (size,) int64."""
    if film is None:
        return np.zeros(size, np.int64), np.full(size, size)
    outline = _extreme(film)  # in order around the hull
    begin, end = outline, np.roll(outline, -1, axis=0)
    rows = np.arange(size)[:, None]
    low = np.maximum(np.minimum(begin[:, 1], end[:, 1]), rows - _MARGIN)
    high = np.minimum(np.maximum(begin[:, 1], end[:, 1]), rows + 1 + _MARGIN)
    rise = end[:, 1] - begin[:, 1]
    slope = np.where(rise != 0, (end[:, 0] - begin[:, 0]) / np.where(rise != 0, rise, 1), 0)
    ends = [begin[:, 0] + slope * (y - begin[:, 1]) for y in (low, high)]
    ends += [np.where(rise != 0, ends[0], end[:, 0])]
    crosses = low <= high
    left = np.min([np.where(crosses, x, np.inf) for x in ends], axis=(0, 2))
    right = np.max([np.where(crosses, x, -np.inf) for x in ends], axis=(0, 2))
    seen = left <= right
    first = np.where(seen, np.floor(np.where(seen, left, 0)) - _MARGIN, 0)
    behind = np.where(seen, np.floor(np.where(seen, right, 0)) + 1 + _MARGIN, 0)
    return np.clip(first, 0, size).astype(np.int64), np.clip(behind, 0, size).astype(np.int64)
