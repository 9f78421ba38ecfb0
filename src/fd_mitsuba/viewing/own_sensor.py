"""A scene as one of its own sensors shows it, by stock Mitsuba."""

from __future__ import annotations

import difflib

import numpy as np
import torch

from fd_mitsuba.errors import UserError
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.viewing.photo_set import SAMPLES_AT_ONCE, spread_seed
from fd_mitsuba.viewing.sheets import as_bytes


def seen_by(file: SceneFile, sensor_id: str, spp: int, max_depth: int, seed: int = 0) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of the film's size, by the integrator `path`.

    Nothing is exposed, balanced or smoothed: it is what `mitsuba scene.xml` renders, in eight bits.

    Args:
        sensor_id: as in the scene file; "" takes the only one.

    Raises:
        UserError: no such sensor, or none, or several to choose from.
    """
    mi = file.mi
    ids = [element.id for element in file.top_level("sensor")]
    scene = file.instantiate()
    sensor = scene.sensors()[_number(file, sensor_id, ids)]
    width, height = (int(side) for side in sensor.film().crop_size())
    path = mi.load_dict({"type": "path", "max_depth": max_depth})
    total, left = np.zeros((height, width, 3), np.float32), spp
    while left > 0:  # in portions: the memory of a rendering grows with its samples
        now = min(left, max(1, SAMPLES_AT_ONCE // (width * height)))
        own = spread_seed(seed * 4096 + left)
        drawn = np.array(mi.render(scene, sensor=sensor, integrator=path, spp=now, seed=own))
        total += np.nan_to_num(_rgb(drawn), posinf=0.0, neginf=0.0) * (now / spp)
        left -= now
    return as_bytes(to_srgb(torch.from_numpy(total).permute(2, 0, 1)[None]))[0]


def _number(file: SceneFile, wanted: str, ids: list[str]) -> int:
    if not ids:
        raise UserError(f"{file.path}: no sensor; add one to the scene, or leave out --sensor")
    if wanted in ids:
        return ids.index(wanted)
    if not wanted and len(ids) == 1:
        return 0
    near = difflib.get_close_matches(wanted, ids, n=3, cutoff=0.5) or ids
    raise UserError(f"--sensor {wanted}: {file.path} has none of this id; there are {', '.join(near)}")


def _rgb(pixels: np.ndarray) -> np.ndarray:
    return pixels[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
