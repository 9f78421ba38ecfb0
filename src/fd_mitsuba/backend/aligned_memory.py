"""numpy arrays at one memory alignment, so that Dr.Jit's kernels are compiled once."""

from __future__ import annotations

import numpy as np

_ALIGNMENT = 64


def aligned(values: np.ndarray, dtype: type) -> np.ndarray:
    """A flat copy of a numeric type that begins at a multiple of 64 bytes.

    Dr.Jit reads numpy's memory in place and writes the alignment of every array into the kernel. numpy's allocator
    gives now this alignment and now that one, so the same pass would be compiled again for each new combination.
    """
    flat, width = np.asarray(values).reshape(-1), np.dtype(dtype).itemsize
    buffer = np.empty(flat.size * width + _ALIGNMENT, dtype=np.uint8)
    offset = -buffer.ctypes.data % _ALIGNMENT
    copy = buffer[offset : offset + flat.size * width].view(dtype)
    np.copyto(copy, flat, casting="unsafe")
    return copy
