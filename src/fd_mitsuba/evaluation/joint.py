"""The curves along which a part meets the base: how sharply they turn, and how deep their notches are.

A curve is where the base's surface crosses the part's triangles. A part is closed, so each curve is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from fd_mitsuba.scene.mesh_distance import MeshDistance

_NOTCH_CELLS = 12.0
"""A notch is what a parabola through so many cells of the curve leaves out, or through a third of a shorter curve."""
_SHORTEST_CELLS = 4.0
_STEPS_A_CELL = 4


@dataclass(frozen=True)
class Joint:
    """What was measured of all curves of a part.

    Attributes:
        curves: how many closed curves there are.
        length: of all together, in cells.
        turning_deg: (N,) the angle between directions one cell apart, all along the curves.
        sideways_deg: (N,) the same without what the base itself turns: the angle in the base's tangent plane.
        notches: (N,) the distance in cells of points all along the curves from the smoothed curves.
        sideways_notches: (N,) the same without what the base itself bends: within the base's tangent plane.
    """

    curves: int
    length: float
    turning_deg: np.ndarray
    sideways_deg: np.ndarray
    notches: np.ndarray
    sideways_notches: np.ndarray


def measure_joint(vertices: np.ndarray, faces: np.ndarray, base: MeshDistance, cell: float) -> Joint:
    """The joint of a closed part with the base; curves shorter than four cells count, but have no angles.

    Args:
        cell: the training lattice's spacing, in the frame's unit.
    """
    turning, sideways, notches, flat_notches = ([np.zeros(0)] for _ in range(4))
    length = 0.0
    curves = joint_curves(vertices, faces, base)
    for curve in curves:
        around = float(np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1).sum()) / cell
        length += around
        count = int(round(around)) * _STEPS_A_CELL
        if around < _SHORTEST_CELLS:
            continue
        points = resampled(curve, count)
        ahead = np.roll(points, -_STEPS_A_CELL, axis=0) - points
        behind = points - np.roll(points, _STEPS_A_CELL, axis=0)
        turning.append(_angles_deg(ahead, behind))
        upward = _upward(base, points, cell)
        window = int(min(_NOTCH_CELLS, around / 3) * _STEPS_A_CELL) // 2 * 2 + 1
        notch = points - savgol_filter(points, window, 2, axis=0, mode="wrap")
        flat = [rows - upward * np.einsum("ij,ij->i", rows, upward)[:, None] for rows in (ahead, behind, notch)]
        sideways.append(_angles_deg(flat[0], flat[1]))
        notches.append(np.linalg.norm(notch, axis=1) / cell)
        flat_notches.append(np.linalg.norm(flat[2], axis=1) / cell)
    measured = (np.concatenate(rows) for rows in (turning, sideways, notches, flat_notches))
    return Joint(len(curves), length, *measured)


def _angles_deg(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    across = np.linalg.norm(np.cross(one, other), axis=1)
    return np.degrees(np.arctan2(across, np.einsum("ij,ij->i", one, other)))


def _upward(base: MeshDistance, points: np.ndarray, cell: float) -> np.ndarray:
    """Unit normals (N, 3) of the base at points on it, averaged over half a cell."""
    steps = 0.5 * cell * np.eye(3)
    slope = np.stack([base.signed(points + step) - base.signed(points - step) for step in steps], axis=1)
    return -slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)


def joint_curves(vertices: np.ndarray, faces: np.ndarray, base: MeshDistance) -> list[np.ndarray]:
    """The closed curves, each (N, 3) in order, in which the base's surface cuts a closed mesh."""
    vertices = np.asarray(vertices, dtype=np.float64)
    depth = base.signed(vertices)
    inside = depth > 0
    count = len(vertices)
    following: dict[int, int] = {}
    place: dict[int, np.ndarray] = {}
    mixed = np.flatnonzero(inside[faces].any(axis=1) & ~inside[faces].all(axis=1))
    for a, b, c in faces[mixed]:
        # One corner is alone on its side; the curve runs with the inside on its left.
        if inside[b] == inside[c]:
            ends = (a, b), (c, a)
        elif inside[a] == inside[c]:
            ends = (b, c), (a, b)
        else:
            ends = (c, a), (b, c)
        keys = []
        for one, other in ends:
            low, high = min(one, other), max(one, other)
            key = int(low) * count + int(high)
            share = depth[low] / (depth[low] - depth[high])
            place[key] = vertices[low] + share * (vertices[high] - vertices[low])
            keys.append(key)
        alone = a if inside[b] == inside[c] else b if inside[a] == inside[c] else c
        start, end = keys if inside[alone] else keys[::-1]
        following[start] = end
    curves = []
    while following:
        start, key = next(iter(following.items()))
        curve = [place[start]]
        del following[start]
        while key != start:
            curve.append(place[key])
            key = following.pop(key)
        curves.append(np.array(curve))
    return curves


def resampled(curve: np.ndarray, count: int) -> np.ndarray:
    """`count` points (count, 3) at even distances along a closed curve (N, 3)."""
    closed = np.concatenate([curve, curve[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.arange(count) / count * along[-1]
    return np.stack([np.interp(at, along, closed[:, axis]) for axis in range(3)], axis=1)
