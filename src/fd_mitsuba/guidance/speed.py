"""How fast this machine runs the networks of Stable Diffusion, measured in a moment."""

from __future__ import annotations

import time

import torch

from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.guidance.memory import BYTES

_CHANNELS, _SIDE, _KERNEL = 320, 32, 3
"""Of the convolutions that Stable Diffusion 1.5's UNet has most of."""
_OPERATIONS = 2 * _CHANNELS**2 * _KERNEL**2 * _SIDE**2


@network_threads()
def measured_speed(device: str, dtype: str, seconds: float = 0.2) -> float | None:
    """Floating-point operations a second of a convolution of that UNet; None where the device is not there.

    Args:
        seconds: how long is measured, at most about twice as long on a slow machine; a first run is not counted.
    """
    if dtype not in BYTES:
        raise ValueError(f"dtype {dtype!r}: give any of {', '.join(BYTES)}")
    try:
        place, kind = torch.device(device), getattr(torch, dtype)
        layer = torch.nn.Conv2d(_CHANNELS, _CHANNELS, _KERNEL, padding=1, device=place, dtype=kind)
        values = torch.zeros(1, _CHANNELS, _SIDE, _SIDE, device=place, dtype=kind)
        with torch.no_grad():
            return _OPERATIONS / _seconds_a_run(layer, values, seconds)
    except (RuntimeError, AssertionError):  # no such device, or one that cannot do this
        return None


def _seconds_a_run(layer: torch.nn.Module, values: torch.Tensor, seconds: float) -> float:
    _finish(layer(values))
    runs, start = 0, time.perf_counter()
    while True:
        _finish(layer(values))
        runs += 1
        if (passed := time.perf_counter() - start) >= seconds:
            return passed / runs


def _finish(result: torch.Tensor) -> None:
    """Wait for a device that computes while Python goes on."""
    result[0, 0, 0, 0].item()
