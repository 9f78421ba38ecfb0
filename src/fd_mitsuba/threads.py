"""How torch and Dr.Jit share the processor's cores."""

from __future__ import annotations

import os


def share_cores(threads: int = 0) -> None:
    spin = os.environ.get("X_SPIN")
    if spin:
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    from fd_mitsuba.mitsuba_api import start

    start(threads=int(os.environ.get("X_DR", "0")))
    import torch

    t = int(os.environ.get("X_TORCH", "0"))
    if t:
        torch.set_num_threads(t)
