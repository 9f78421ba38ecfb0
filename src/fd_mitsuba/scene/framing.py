"""Where cameras look: the middle and the reach of a set of points."""

from __future__ import annotations

import numpy as np


def centre_of_box(points: np.ndarray) -> np.ndarray:
    """Centre (3,) of the bounding box of points (N, 3)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def bounding_ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """That centre, and the distance from it to the farthest point."""
    centre = centre_of_box(points)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())
