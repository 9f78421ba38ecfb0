"""Cameras that see all of a set of points, as large as the frame allows."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.scene.views import CameraBatch

_ROUNDS = 4
_OFF_AXIS_DEG = 0.1
"""Cameras along an axis would have zeros in their matrices, for which a renderer compiles kernels of their own."""


def framed_camera(
    points: np.ndarray, azimuth_deg: float, elevation_deg: float, fov_deg: float, fill: float = 0.85
) -> CameraBatch:
    """One camera of the given direction whose image the points fill, with the same margin on opposite sides.

    Args:
        points: (N, 3), not all at one place.
        fill: which share of the frame's longer extent the points take, in (0, 1].
    """
    points = np.asarray(points, dtype=np.float64)
    reach = np.tan(np.radians(fov_deg) / 2) * fill
    target, distance = (points.min(axis=0) + points.max(axis=0)) / 2, 0.0
    right, up, back = _axes(azimuth_deg, elevation_deg)
    for left in reversed(range(_ROUNDS)):
        offset = points - target
        across, depth = np.stack([offset @ right, offset @ up], axis=1), offset @ back
        distance = float((np.abs(across).max(axis=1) / reach + depth).max())
        if not left:
            break
        seen = across / (distance - depth)[:, None]
        middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
        target = target + distance * (middle[0] * right + middle[1] * up)
    return _camera(azimuth_deg, elevation_deg, fov_deg, distance, target)


def turned_cameras(
    points: np.ndarray, count: int, elevation_deg: float, fov_deg: float, fill: float
) -> list[CameraBatch]:
    """`count` cameras around the vertical axis through the points' middle, all from one distance, the front first.

    Each sees every point, so the frames of a film of them have one scale.
    """
    points = np.asarray(points, dtype=np.float64)
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    reach, distance = np.tan(np.radians(fov_deg) / 2) * fill, 0.0
    azimuths = _OFF_AXIS_DEG + np.arange(count) * (360.0 / count)
    for azimuth in azimuths:
        right, up, back = _axes(azimuth, elevation_deg)
        offset = points - target
        aside = np.maximum(np.abs(offset @ right), np.abs(offset @ up))
        distance = max(distance, float((aside / reach + offset @ back).max()))
    return [_camera(azimuth, elevation_deg, fov_deg, distance, target) for azimuth in azimuths]


def _axes(azimuth_deg: float, elevation_deg: float) -> list[np.ndarray]:
    """Right, up and back of a camera, (3,) each."""
    return [axis[0].astype(np.float64) for axis in _camera(azimuth_deg, elevation_deg, 30.0, 1.0, np.zeros(3)).basis()]


def _camera(
    azimuth_deg: float, elevation_deg: float, fov_deg: float, distance: float, target: np.ndarray
) -> CameraBatch:
    return CameraBatch.around(np.array([azimuth_deg]), elevation_deg, distance, fov_deg, target[None])
