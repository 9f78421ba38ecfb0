"""Mosaics taken apart into the single views that the judge of parts sees."""

from __future__ import annotations

import numpy as np
import torch

from fd_mitsuba.evaluation.part_judge import VIEW_SIZE
from fd_mitsuba.guidance.mosaic import untile_views


def views_of(mosaics: np.ndarray) -> np.ndarray:
    """The views (4 N, C, S, S) of mosaics (N, C, 2 S, 2 S), those of one mosaic together, row by row."""
    return untile_views(torch.from_numpy(mosaics), 2).numpy()


def seen_by_judge(views: np.ndarray) -> np.ndarray:
    """Views (N, C, S, S) at the judge's size: means of squares of pixels where they are larger."""
    count, channels, side = views.shape[:3]
    step = side // VIEW_SIZE
    return views.reshape(count, channels, VIEW_SIZE, step, VIEW_SIZE, step).mean((3, 5))
