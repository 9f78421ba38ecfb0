"""The scene's own light as the page can show it: what arrives from all around, as an image."""

from __future__ import annotations

from typing import Any

import numpy as np

from fd_mitsuba.io.gain_map import gain_map_jpeg
from fd_mitsuba.scene.edit_scene import EditScene

_HEIGHT = 128
_MEAN = 0.9
"""Mean of what the page is lit by: scenes have their own units, and the page no exposure."""
_BRIGHTEST = 4096.0
_EVEN = 2.0
"""Brightest over mean, below which a light shows no shapes."""


def scene_light(scene: EditScene) -> bytes | None:
    """A JPEG with a gain map of the scene's environment; None where it has none, such as with lamps alone, or an even
    one, under which nothing looks round without the shadows that a page has not.

    Scaled to a fixed mean. Columns run as three.js has them: the middle one looks along +x, those right of it to +z.
    """
    file = scene.inputs.scene
    environment = file.instantiate(("shape", "sensor", "integrator", "bsdf")).environment()
    if environment is None:
        return None
    radiance = _all_around(file.mi, environment)
    weight = np.sin((np.arange(_HEIGHT) + 0.5) * np.pi / _HEIGHT)
    mean = float((radiance.mean(axis=(1, 2)) * weight).sum() / weight.sum())
    if not np.isfinite(mean) or mean <= 0 or radiance.max() < _EVEN * mean:
        return None
    return gain_map_jpeg((radiance * (_MEAN / mean)).clip(0.0, _BRIGHTEST))


def _all_around(mi: Any, environment: Any) -> np.ndarray:
    """(H, W, 3) radiance from everywhere, W = 2 H."""
    around = 2 * np.pi * ((np.arange(2 * _HEIGHT) + 0.5) / (2 * _HEIGHT) - 0.5)
    down = np.pi * (np.arange(_HEIGHT) + 0.5) / _HEIGHT
    across = np.sin(down)[:, None]
    away = np.stack(
        [
            across * np.cos(around),
            np.broadcast_to(np.cos(down)[:, None], (_HEIGHT, 2 * _HEIGHT)),
            across * np.sin(around),
        ],
        axis=-1,
    )
    columns = np.ascontiguousarray(-away.reshape(-1, 3).T, dtype=np.float32)
    surface = mi.SurfaceInteraction3f()
    surface.wi = mi.Vector3f(*columns)
    surface.wavelengths = mi.Color0f()
    radiance = np.array(environment.eval(surface))
    radiance = np.broadcast_to(radiance, (3, columns.shape[1]))  # one number where it is the same from everywhere
    return radiance.reshape(3, _HEIGHT, 2 * _HEIGHT).transpose(1, 2, 0)
