"""Which way an asset points: what it says itself, what the user says, and a guess that is told where neither does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from fd_mitsuba.errors import UserError

_AXES = {"x": 0, "y": 1, "z": 2}
_FRONT_OF = {"+y": "+z", "-y": "+z", "+z": "-y", "-z": "-y", "+x": "+z", "-x": "+z"}
"""Where an object looks by custom, by the axis that points up."""
_SAMPLES = 2000
_LONG, _LEAN = 0.9, 0.15
"""From which length, as a share of the height, the highest points tell what is ahead, if they are so far from the
middle, as a share of the length. Horses, deer and dogs have 0.1 to 0.3, a cat with its tail up 0.1."""


@dataclass(frozen=True)
class Orientation:
    """Axes of an asset, such as "+y" and "-x".

    Attributes:
        up: becomes +y.
        front: becomes +z.
        remarks: what was guessed and how to say otherwise.
    """

    up: str
    front: str
    remarks: tuple[str, ...] = ()

    def matrix(self) -> np.ndarray:
        """(4, 4) rotation from the asset's frame to one with +y up that looks along +z."""
        up, front = axis_vector(self.up), axis_vector(self.front)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([np.cross(up, front), up, front])
        return matrix


def axis_vector(axis: str) -> np.ndarray:
    """(3,) the unit vector of an axis such as "-x"."""
    vector = np.zeros(3)
    vector[_AXES[axis[1]]] = -1.0 if axis[0] == "-" else 1.0
    return vector


def read_axis(option: str, text: str) -> str:
    """An axis as users write it, `z` or `-x`, with its sign; UserError for anything else."""
    word = text.strip().lower()
    word = word if word[:1] in ("+", "-") else f"+{word}"
    if len(word) != 2 or word[1] not in _AXES:
        raise UserError(f"{option} {text}: is no axis; write x, y, z, -x, -y or -z")
    return word


def find_orientation(
    vertices: np.ndarray,
    faces: np.ndarray,
    suffix: str,
    said: tuple[str | None, str | None],
    wanted: tuple[str | None, str | None],
) -> Orientation:
    """The asset's orientation.

    Args:
        vertices: (V, 3) in the asset's frame.
        faces: (F, 3).
        suffix: of the file, whose customs count where nothing else does.
        said: up and front as the file or its format says.
        wanted: up and front as the user says, or None.

    Raises:
        UserError: up and front along the same axis.
    """
    remarks = []
    up = wanted[0] or said[0]
    if up is None:
        up, reason = _likely_up(vertices, suffix)
        remarks.append(f"takes {up} for up ({reason}); --up says otherwise")
    front = wanted[1] or (said[1] if up == said[0] else None)
    if front is None or (said[1] == front and wanted[1] is None):
        front, reason = _likely_front(vertices, faces, up, front or _FRONT_OF[up], front is not None)
        if reason:
            remarks.append(f"takes {front} for its front ({reason}); --front says otherwise")
    if up[1] == front[1]:
        raise UserError(f"--up {up}, --front {front}: must be two different axes")
    return Orientation(up, front, tuple(remarks))


def _likely_up(vertices: np.ndarray, suffix: str) -> tuple[str, str]:
    """An object that stands on 0 of one axis and of no other has that axis up; else the format's custom."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = max(float((high - low).max()), 1e-300)
    stands = np.abs(low) < 0.01 * size
    if stands[1] != stands[2]:
        return ("+y" if stands[1] else "+z"), f"it stands on {'y' if stands[1] else 'z'} = 0"
    return ("+z", "the custom of STL") if suffix == ".stl" else ("+y", "the custom")


def _likely_front(
    vertices: np.ndarray, faces: np.ndarray, up: str, custom: str, is_said: bool
) -> tuple[str, str | None]:
    """The front, and why it may be another one; None where it looks like one.

    Bodies are the same left and right, and what is longer than it is high carries its head before it, high up. Where an
    object is alike about the other upright plane, and is not about that of the custom, it looks sideways; and where no
    format says what is ahead, a long one whose higher part is behind looks backwards.

    Args:
        is_said: whether a format says that `custom` is ahead.
    """
    points = _surface_points(vertices, faces)
    size = np.ptp(points, axis=0)
    forward = axis_vector(custom)
    side = np.abs(np.cross(axis_vector(up), forward))
    uneven = [_asymmetry(points, axis) / float(size.max()) for axis in (side, np.abs(forward))]
    if uneven[0] >= 2 * uneven[1] and uneven[0] >= 0.01:
        front = _along("-" if _lean(points, up, side) < 0 else "+", side)
        return front, "the custom" if front == custom else "its left and right are alike then"
    is_long = size @ np.abs(forward) > _LONG * (size @ np.abs(axis_vector(up)))
    if is_long and not is_said and _lean(points, up, forward) < -_LEAN:
        return _along("-" if custom[0] == "+" else "+", np.abs(forward)), "its higher part is there"
    return custom, None


def _along(sign: str, axis: np.ndarray) -> str:
    return sign + "xyz"[int(np.argmax(axis))]


def _lean(points: np.ndarray, up: str, direction: np.ndarray) -> float:
    """How far the highest of the points lie along a unit vector from the middle, as a share of the object's length."""
    height, along = points @ axis_vector(up), points @ direction
    top = along[height > np.quantile(height, 0.85)]
    return float((top.mean() - (along.min() + along.max()) / 2) / np.ptp(along))


def _surface_points(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    random = np.random.default_rng(0)
    weight = area / area.sum() if area.sum() > 0 else None
    chosen = random.choice(len(corners), size=_SAMPLES, p=weight)
    return np.einsum("ij,ijk->ik", random.dirichlet([1.0, 1.0, 1.0], size=_SAMPLES), corners[chosen])


def _asymmetry(points: np.ndarray, axis: np.ndarray) -> float:
    """Mean distance between points and their mirror images about the middle of their box across a unit axis."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    mirrored = points - 2 * ((points - middle) @ axis)[:, None] * axis
    return float(KDTree(points).query(mirrored)[0].mean())
