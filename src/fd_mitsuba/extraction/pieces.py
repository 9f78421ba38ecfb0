"""The pieces that marked vertices of the lattice fall into, connected along the grid's edges like its surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

_UPWARDS = np.zeros((3, 3, 3), dtype=bool)
_UPWARDS[1:, 1:, 1:] = True
_NEIGHBOURS = _UPWARDS | _UPWARDS[::-1, ::-1, ::-1]
"""The vertices (z, y, x) that an edge joins to the middle one, and itself."""


def label_pieces(marked: np.ndarray) -> tuple[np.ndarray, int]:
    """The number (z, y, x) of each marked vertex's piece, from 1 on, and how many there are; 0 where not marked."""
    found: Any = ndimage.label(marked, _NEIGHBOURS)  # its annotations leave all that it can return
    return found
