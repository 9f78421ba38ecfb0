"""Cameras: where they stand, what they look at, and the word for the side that they see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.config import CamerasConfig


@dataclass(frozen=True)
class CameraBatch:
    """Perspective cameras in the canonical frame; all arrays float32.

    position = target + r (cos el sin az, sin el, cos el cos az), with r the distance to the target.

    Attributes:
        position: (B, 3).
        target: (B, 3), the point in the middle of the picture.
        fov_deg: (B,) full opening angle, vertical and horizontal alike: pictures are square.
        azimuth_deg: (B,) in [0, 360): 0 stands on +z and sees the front, 90 stands on +x.
        elevation_deg: (B,) in [-90, 90], towards +y.
    """

    position: np.ndarray
    target: np.ndarray
    fov_deg: np.ndarray
    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray

    def __post_init__(self) -> None:
        for name in ("position", "target", "fov_deg", "azimuth_deg", "elevation_deg"):
            array = np.array(getattr(self, name), dtype=np.float32)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def around(
        cls,
        azimuth_deg: np.ndarray,
        elevation_deg: np.ndarray | float,
        radius: np.ndarray | float,
        fov_deg: np.ndarray | float,
        target: np.ndarray | None = None,
    ) -> CameraBatch:
        """Cameras at the given angles (B,) and distance `radius` from `target` (B, 3), by default the origin."""
        azimuth = np.atleast_1d(np.asarray(azimuth_deg, dtype=np.float64))
        count = len(azimuth)
        elevation = np.broadcast_to(np.asarray(elevation_deg, dtype=np.float64), (count,))
        distance = np.broadcast_to(np.asarray(radius, dtype=np.float64), (count,))
        centre = np.broadcast_to(np.zeros(3) if target is None else np.asarray(target, dtype=np.float64), (count, 3))
        az, el = np.radians(azimuth), np.radians(elevation)
        direction = np.stack([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)], axis=1)
        wrapped = np.mod(azimuth, 360.0).astype(np.float32) % np.float32(
            360.0
        )  # rounding to float32 may give 360 itself
        fov = np.broadcast_to(np.asarray(fov_deg, dtype=np.float64), (count,))
        return cls(centre + distance[:, None] * direction, centre, fov, wrapped, elevation)

    def __len__(self) -> int:
        return len(self.fov_deg)

    def some(self, chosen: slice) -> CameraBatch:
        """Some of the cameras, in their order."""
        names = ("position", "target", "fov_deg", "azimuth_deg", "elevation_deg")
        return CameraBatch(**{name: getattr(self, name)[chosen] for name in names})

    def basis(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The cameras' unit axes right, up, back: (B, 3) float32 each, right-handed (right x up = back).

        `back` points from the target to the camera: it is +z of the camera space. Straight above or below the target
        the azimuth says which way is up.
        """
        back = self.position.astype(np.float64) - self.target.astype(np.float64)
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        right = np.stack([back[:, 2], np.zeros(len(back)), -back[:, 0]], axis=1)  # +y x back
        length = np.linalg.norm(right, axis=1, keepdims=True)
        az = np.radians(self.azimuth_deg.astype(np.float64))
        by_azimuth = np.stack([np.cos(az), np.zeros(len(az)), -np.sin(az)], axis=1)
        right = np.where(length > 1e-4, right / np.maximum(length, 1e-12), by_azimuth)
        up = np.cross(back, right)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        right = np.cross(up, back)
        return right.astype(np.float32), up.astype(np.float32), back.astype(np.float32)

    def labels(self) -> list[str]:
        """`view_label` of every camera."""
        return [view_label(float(azimuth)) for azimuth in self.azimuth_deg]


def view_label(azimuth_deg: float) -> str:
    """The view's word for prompts: "front" within 45 degrees of azimuth 0, "back" beyond 135, else "side".

    Any number of turns may be added. Source: the paper's supplement, "Camera and Light Settings".
    """
    off_front = abs((azimuth_deg + 180.0) % 360.0 - 180.0)
    if off_front <= 45.0:
        return "front"
    return "back" if off_front > 135.0 else "side"


def sample_views(
    cameras: CamerasConfig,
    count: int,
    seed: int,
    focus: tuple[np.ndarray, float] | None = None,
    centre: np.ndarray | None = None,
    together: int = 1,
) -> CameraBatch:
    """`count` random cameras, one in each of `count` equal slices of azimuth; the same for the same `seed`.

    View k has its azimuth uniform in [360 k / count, 360 (k + 1) / count); elevation and fov are uniform in the
    configured ranges, and the target is uniform in a cube of half side `centre_jitter`.

    Source: the paper's supplement, "Camera and Light Settings".

    Args:
        focus: centre (3,) and radius of a ball to look at, in the canonical frame. The cameras then aim at its centre
            from the usual distance, which keeps them outside the object, and are close by a narrower fov: the ball
            fills between 1/1.6 and 1/1.2 of the picture, unless that would need more than the sampled fov.
        centre: (3,) what to aim at without `focus`; None is the origin.
        together: views of one mosaic. Each run of that many shares elevation, fov and target, and is evenly spread
            around the object from an azimuth that is uniform in the run's slice. Divides `count`.
    """
    if count % together:
        raise ValueError(f"{count} views cannot be put together by {together}")
    random = np.random.default_rng(seed)
    groups = count // together
    start = (np.arange(groups) + random.random(groups)) * (360.0 / count)
    azimuth = (start[:, None] + np.arange(together) * (360.0 / together)).ravel()
    elevation = random.uniform(*cameras.elevation_deg, size=groups)
    fov = random.uniform(*cameras.fov_deg, size=groups)
    target = random.uniform(-1.0, 1.0, size=(groups, 3)) * cameras.centre_jitter
    zoom = random.uniform(1.2, 1.6, size=groups)
    if focus is not None:
        target = target + np.asarray(focus[0], dtype=np.float64)
        fov = np.minimum(fov, close_fov(zoom, focus[1], cameras.radius))
    elif centre is not None:
        target = target + np.asarray(centre, dtype=np.float64)
    elevation, fov, target = (np.repeat(values, together, axis=0) for values in (elevation, fov, target))
    return CameraBatch.around(azimuth, elevation, cameras.radius, fov, target)


def close_fov(zoom: np.ndarray | float, ball_radius: float, distance: float) -> np.ndarray:
    """Opening angle in degrees at which a ball of `zoom` times the radius touches the picture's borders.

    Args:
        distance: of the camera from the ball's centre; 180 degrees where it is within the ball.
    """
    return 2.0 * np.degrees(np.arcsin(np.minimum(zoom * float(ball_radius) / distance, 1.0)))


def ring_views(count: int, elevation_deg: float = 20.0, fov_deg: float = 45.0, radius: float = 3.0) -> CameraBatch:
    """`count` cameras on a ring around the origin, evenly spaced from azimuth 0 (the front) on."""
    return CameraBatch.around(np.arange(count) * (360.0 / count), elevation_deg, radius, fov_deg)
