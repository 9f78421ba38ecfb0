"""How fast one core of this machine is now, measured in a moment."""

from __future__ import annotations

import time
from functools import cache

_SIDE, _TIMES = 512, 15


@cache
def processor_speed() -> float:
    """Floating-point operations a second of one thread of torch in a product of matrices, float32; once a process.

    The best of fifteen, so that other work on the machine hardly counts; 0.05 s.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        matrix = torch.rand(_SIDE, _SIDE, generator=torch.Generator().manual_seed(0))
        seconds = []
        for _ in range(_TIMES):
            start = time.perf_counter()
            _ = matrix @ matrix
            seconds.append(time.perf_counter() - start)
    finally:
        torch.set_num_threads(before)
    return 2.0 * _SIDE**3 / min(seconds)
