"""What the benchmarks share: how they print figures, the machine, its memory, and the kernels that a step compiles."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any


def print_figures(figures: dict[str, Any], as_json: bool) -> None:
    """Print them and the machine that they depend on: as JSON, or a line each for people."""
    figures = {**figures, "machine": machine()}
    if as_json:
        print(json.dumps(figures, indent=2))
        return
    for name, value in figures.items():
        print(f"{name:20} {value}")


def kernels_compiled(steps: Callable[[], Any]) -> int:
    """How many kernels Dr.Jit had to compile, or to read from its disk cache, while `steps` ran."""
    import drjit as dr

    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        steps()
        return sum(not entry["cache_hit"] for entry in dr.kernel_history() if "cache_hit" in entry)
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np
    import torch

    cpu = next((line.split(":", 1)[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")), "")
    return {
        "cpu": cpu or platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "torch_threads": torch.get_num_threads(),
        "drjit_threads": dr.thread_count(),
        "python": platform.python_version(),
        "mitsuba": mi.__version__,
        "numpy": np.__version__,
        "torch": torch.__version__,
        "drjit": dr.__version__,
    }


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
