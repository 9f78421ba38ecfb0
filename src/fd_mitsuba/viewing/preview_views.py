"""The named views of a preview: parallel projections, so that a length is as long everywhere in a picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fd_mitsuba.scene.views import CameraBatch

VIEW_NAMES = ("front", "left", "top", "three-quarter", "back", "right", "below", "three-quarter back")
"""In the order of the sheet. `left` shows the object's own left, which is at +x."""
_ANGLES = {
    "front": (0, 0), "left": (90, 0), "back": (180, 0), "right": (270, 0), "top": (0, 90), "below": (0, -90),
    "three-quarter": (35, 25), "three-quarter back": (215, 25),
}  # fmt: skip
_FARTHEST = 10.0


@dataclass(frozen=True)
class ParallelView:
    """A square picture seen from infinitely far away.

    Attributes:
        name: of `VIEW_NAMES`.
        right, up, back: (3,) unit axes of the picture; `back` points at the viewer.
        centre: (3,) what is in the middle of the picture, canonical frame.
        half: half a side of the picture, canonical units.
    """

    name: str
    right: np.ndarray
    up: np.ndarray
    back: np.ndarray
    centre: np.ndarray
    half: float

    @classmethod
    def named(cls, name: str, centre: np.ndarray, half: float) -> ParallelView:
        """One of `VIEW_NAMES`."""
        azimuth, elevation = _ANGLES[name]
        camera = CameraBatch.around(np.array([azimuth]), elevation, 1.0, 45.0)
        right, up, back = (np.round(axis[0].astype(np.float64), 7) for axis in camera.basis())
        return cls(name, right, up, back, centre, half)

    @property
    def is_along_an_axis(self) -> bool:
        """Whether the picture's axes are those of the scene."""
        return bool((np.abs(self.back) > 0.999).any())

    def rays(self, pixels: int) -> tuple[np.ndarray, np.ndarray]:
        """Origins (pixels^2, 3) of the rays through pixel centres, row 0 at the top, and their direction (3,)."""
        across = (2 * (np.arange(pixels) + 0.5) / pixels - 1) * self.half
        x, y = np.meshgrid(across, -across)
        start = self.centre + _FARTHEST * self.back
        return (start + x.reshape(-1, 1) * self.right + y.reshape(-1, 1) * self.up), -self.back

    def project(self, points: np.ndarray, size: int) -> np.ndarray:
        """(N, 2) place in a picture of `size` pixels a side of canonical points (N, 3): right and down."""
        offset = np.atleast_2d(points) - self.centre
        plane = np.stack([offset @ self.right, -(offset @ self.up)], axis=1)
        return (plane / self.half + 1) / 2 * size

    def sensor(self, mi: Any, to_user: Callable[[np.ndarray], np.ndarray], size: int) -> Any:
        """Mitsuba's camera for it; `to_user` is the map from the canonical frame to that of the scene."""
        position, target = to_user(self.centre + _FARTHEST * self.back), to_user(self.centre)
        reach = float(np.linalg.norm(position - target))
        place = mi.ScalarTransform4f().look_at(origin=position.tolist(), target=target.tolist(), up=self.up.tolist())
        half = reach * self.half / _FARTHEST
        return mi.load_dict(
            {
                "type": "orthographic",
                "near_clip": 1e-3 * reach,
                "far_clip": 1e2 * reach,
                "to_world": place @ mi.ScalarTransform4f().scale([half, half, 1.0]),
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


def preview_views(names: tuple[str, ...], corners: np.ndarray) -> list[ParallelView]:
    """Views of one scale that show all of some points (N, 3), canonical frame, with a margin."""
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    half = 1.12 * float(np.abs(corners - centre).max())
    views = [ParallelView.named(name, centre, half) for name in names]
    wide = [
        max(1.0, float(np.abs(view.project(corners, 2) - 1).max()) * 1.04) if not view.is_along_an_axis else 1.0
        for view in views
    ]
    return [ParallelView.named(view.name, centre, half * more) for view, more in zip(views, wide, strict=True)]
