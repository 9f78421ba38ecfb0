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
        custom = front or _FRONT_OF[up]
        front, sure = _likely_front(vertices, faces, up, custom)
        if not sure:
            remarks.append(f"takes {front} for its front ({_reason(front, custom)}); --front says otherwise")
    if up[1] == front[1]:
        raise UserError(f"--up {up}, --front {front}: must be two different axes")
    return Orientation(up, front, tuple(remarks))


def _reason(front: str, custom: str) -> str:
    return "the custom" if front == custom else "its left and right are alike then"


def _likely_up(vertices: np.ndarray, suffix: str) -> tuple[str, str]:
    """An object that stands on 0 of one axis and of no other has that axis up; else the format's custom."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = max(float((high - low).max()), 1e-300)
    stands = np.abs(low) < 0.01 * size
    if stands[1] != stands[2]:
        return ("+y" if stands[1] else "+z"), f"it stands on {'y' if stands[1] else 'z'} = 0"
    return ("+z", "the custom of STL") if suffix == ".stl" else ("+y", "the custom")


def _likely_front(vertices: np.ndarray, faces: np.ndarray, up: str, custom: str) -> tuple[str, bool]:
    """The front, and whether it is the custom's and looks like one.

    Bodies are the same left and right. Where an object is so about the other upright plane, and is not about that of
    the custom, it looks sideways: to where its higher half is, as heads are.
    """
    points = _surface_points(vertices, faces)
    size = float(np.ptp(points, axis=0).max())
    forward = axis_vector(custom)
    side = np.abs(np.cross(axis_vector(up), forward))
    uneven = {name: _asymmetry(points, axis) / size for name, axis in (("side", side), ("front", np.abs(forward)))}
    if uneven["side"] < 2 * uneven["front"] or uneven["side"] < 0.01:
        return custom, True
    height = points @ axis_vector(up)
    top = points[height > np.quantile(height, 0.85)]
    lean = float((top.mean(axis=0) - (points.min(axis=0) + points.max(axis=0)) / 2) @ side)
    letter = "xyz"[int(np.argmax(side))]
    return f"{'-' if lean < 0 else '+'}{letter}", False


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
