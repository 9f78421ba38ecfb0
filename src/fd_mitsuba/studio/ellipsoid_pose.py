"""A focal region as a person handles it: where it is, how it is turned, three radii."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.scene.focal_region import ADD, SUBTRACT

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class EllipsoidPose:
    """An ellipsoid in the user frame.

    Attributes:
        name: the shape's id in the scene file.
        centre: (3,) user units.
        wxyz: unit quaternion that turns the ellipsoid's own axes into the user frame's.
        radii: half lengths along its own axes, user units, positive.
        part: the editable part that it belongs to.
        mode: as of a `FocalRegion`.
        prompt, negative_prompt: of its part, as of a `PartPrompt`; "": the part has none, or another region says it.

    Example:
        EllipsoidPose("hat", (0, 1.2, 0), (1, 0, 0, 0), (0.3, 0.4, 0.3)).mirrored("hat_2", axis=0, middle=0.5)
    """

    name: str
    centre: Vector
    wxyz: Quaternion
    radii: Vector
    part: str = DEFAULT_PART_NAME
    mode: str = ADD
    prompt: str = ""
    negative_prompt: str = ""

    @classmethod
    def of_matrix(cls, name: str, matrix: np.ndarray, part: str = DEFAULT_PART_NAME, mode: str = ADD) -> EllipsoidPose:
        """The image of the unit sphere under an affine map (4, 4); its axes keep the map's order where they can."""
        linear = np.asarray(matrix, dtype=np.float64)[:3, :3]
        radii = np.linalg.norm(linear, axis=0)
        axes = linear / radii
        if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-6):  # sheared: the sphere does not see the last rotation
            axes, radii, _ = np.linalg.svd(linear)
        if np.linalg.det(axes) < 0:
            axes = axes * np.array([1.0, 1.0, -1.0])
        return cls(name, vector(matrix[:3, 3]), quaternion(axes), vector(radii), part, mode)

    @classmethod
    def of_json(cls, row: dict[str, Any]) -> EllipsoidPose:
        """From `to_json`; KeyError, TypeError or ValueError where it is none."""
        place = vector(row["centre"]), _unit(row["wxyz"]), vector(row["radii"])
        mode = SUBTRACT if row["mode"] == SUBTRACT else ADD
        words = str(row.get("prompt", "")), str(row.get("negative_prompt", ""))
        pose = cls(str(row["name"]), *place, str(row["part"]), mode, *words)
        if min(pose.radii) <= 0:
            raise ValueError("a radius is not positive")
        return pose

    def to_json(self) -> dict[str, Any]:
        """Plain values for `json.dumps`."""
        return asdict(self)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) columns are its own axes in the user frame."""
        return rotation_matrix(self.wxyz)

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) the map from the unit sphere to the ellipsoid: `to_world` of the focal region."""
        result = np.eye(4)
        result[:3, :3] = self.rotation * np.array(self.radii)
        result[:3, 3] = self.centre
        return result

    def moved(
        self, centre: Sequence[float] | np.ndarray, wxyz: Sequence[float] | np.ndarray | None = None
    ) -> EllipsoidPose:
        """The ellipsoid elsewhere, turned too where `wxyz` is given."""
        return replace(self, centre=vector(centre), wxyz=self.wxyz if wxyz is None else _unit(wxyz))

    def mirrored(self, name: str, axis: int, middle: float) -> EllipsoidPose:
        """Its image in the plane where coordinate `axis` is `middle`, called `name`, of the same part."""
        flip = np.ones(3)
        flip[axis] = -1
        centre = np.array(self.centre)
        centre[axis] = 2 * middle - centre[axis]
        # A mirror in front and behind is a rotation again, and the ellipsoid does not see the one behind.
        turned = flip[:, None] * self.rotation * flip
        return replace(self, name=name, centre=vector(centre), wxyz=quaternion(turned))

    def lies_on(self, other: EllipsoidPose) -> bool:
        """Whether both are the same set of points, to a hundredth of the radii."""
        mine, theirs = (p.rotation * np.square(p.radii) @ p.rotation.T for p in (self, other))
        near = np.linalg.norm(np.subtract(self.centre, other.centre)) < 1e-2 * min(self.radii)
        return bool(near and np.abs(mine - theirs).max() < 1e-2 * min(self.radii) ** 2)


def vector(values: Sequence[float] | np.ndarray) -> Vector:
    """Three finite numbers; ValueError where they are not."""
    x, y, z = (float(value) for value in values)
    if not np.isfinite([x, y, z]).all():
        raise ValueError("a coordinate is not finite")
    return x, y, z


def quaternion(rotation: np.ndarray) -> Quaternion:
    """The unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (3, 3)."""
    # The eigenvector of this symmetric matrix (Bar-Itzhack 2000): no case distinction, and exact to rounding.
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64)
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return _unit(np.linalg.eigh(symmetric)[1][:, -1])


def rotation_matrix(wxyz: Sequence[float]) -> np.ndarray:
    """(3, 3) of a unit quaternion."""
    w, x, y, z = wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turned_to(direction: np.ndarray) -> Quaternion:
    """The shortest rotation that takes the y axis to a unit direction (3,)."""
    up, to = np.array([0.0, 1.0, 0.0]), np.asarray(direction, dtype=np.float64)
    w = 1.0 + float(up @ to)
    if w < 1e-9:
        return 0.0, 1.0, 0.0, 0.0  # upside down: half a turn around x
    return _unit([w, *np.cross(up, to)])


def _unit(values: Sequence[float] | np.ndarray) -> Quaternion:
    wxyz = np.array([float(value) for value in values])
    length = np.linalg.norm(wxyz)
    if wxyz.shape != (4,) or not np.isfinite(length) or length < 1e-9:
        raise ValueError("not a rotation")
    w, x, y, z = (wxyz / (length if wxyz[0] >= 0 else -length)).tolist()
    return w, x, y, z
