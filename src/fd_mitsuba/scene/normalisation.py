"""The map between the user's frame and the canonical frame (see `conventions`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.conventions import BASE_LONGEST_SIDE


@dataclass(frozen=True)
class Normalisation:
    """canonical = scale * (user - centre): no rotation, so that axes and angles mean the same in both frames.

    Attributes:
        centre: (3,) float64, centre of the base's bounding box in the user frame, or of that of base and regions
            where these need room (`headroom`).
        scale: canonical units a user unit, positive.
    """

    centre: np.ndarray
    scale: float

    @classmethod
    def of_points(cls, points: np.ndarray) -> Normalisation:
        """The map that centres the bounding box of `points` (N, 3) and makes its longest side `BASE_LONGEST_SIDE`.

        Raises:
            ValueError: the box has no extent, or a coordinate is not finite.
        """
        points = np.asarray(points, dtype=np.float64)
        low, high = points.min(axis=0), points.max(axis=0)
        longest = float((high - low).max())
        if not np.isfinite(longest) or longest <= 0:
            raise ValueError("the points have no extent")
        centre = (low + high) / 2
        centre.setflags(write=False)
        return cls(centre, BASE_LONGEST_SIDE / longest)

    def to_canonical(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the user frame in the canonical frame, float64."""
        return (np.asarray(points, dtype=np.float64) - self.centre) * self.scale

    def to_user(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the canonical frame in the user frame, float64."""
        return np.asarray(points, dtype=np.float64) / self.scale + self.centre

    def matrix(self) -> np.ndarray:
        """The map user -> canonical as (4, 4) float64."""
        matrix = np.diag([self.scale, self.scale, self.scale, 1.0])
        matrix[:3, 3] = -self.scale * self.centre
        return matrix
