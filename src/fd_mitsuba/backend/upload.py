"""numpy arrays to Dr.Jit, always at the same memory alignment."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.aligned_memory import aligned


def upload_floats(values: np.ndarray) -> mi.Float:
    """A flat float32 copy."""
    return mi.Float(aligned(values, np.float32))


def upload_indices(values: np.ndarray) -> mi.UInt32:
    """A flat uint32 copy of non-negative integers."""
    return mi.UInt32(aligned(values, np.uint32))


def upload_doubles(values: np.ndarray) -> mi.Float64:
    """A flat float64 copy."""
    return mi.Float64(aligned(values, np.float64))
