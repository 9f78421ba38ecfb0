"""How much memory this process has needed."""

from __future__ import annotations

import resource
import sys


def peak_memory_mb() -> int:
    """The most memory that this process has held so far, in units of 2^20 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))
