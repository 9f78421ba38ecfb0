"""numpy arrays to Dr.Jit, always at the same memory alignment."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

_ALIGNMENT = 64


def upload_floats(values: np.ndarray) -> mi.Float:
    """A flat float32 copy."""
    return mi.Float(_aligned(values, np.float32))


def upload_indices(values: np.ndarray) -> mi.UInt32:
    """A flat uint32 copy of non-negative integers."""
    return mi.UInt32(_aligned(values, np.uint32))


def _aligned(values: np.ndarray, dtype: type) -> np.ndarray:
    """A flat copy that begins at a multiple of 64 bytes.

    Dr.Jit reads numpy's memory in place and writes the alignment of every array into the kernel. numpy's allocator
    gives now this alignment and now that one, so the same pass would be compiled again for each new combination.
    """
    flat = np.asarray(values).reshape(-1)
    buffer = np.empty(flat.size * 4 + _ALIGNMENT, dtype=np.uint8)
    offset = -buffer.ctypes.data % _ALIGNMENT
    aligned = buffer[offset : offset + flat.size * 4].view(dtype)
    np.copyto(aligned, flat, casting="unsafe")
    return aligned
