"""Whether torch can compute where `guidance.device` says."""

from __future__ import annotations

import torch

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError


def own_device(name: str) -> str:
    """The device of a name for this process: `cuda` is a card of its own for each of several processes."""
    group = processes()
    if name != "cuda" or group.local_count == 1:
        return name
    return f"cuda:{group.local_rank % max(torch.cuda.device_count(), 1)}"


def field_device(config: GuidanceConfig) -> torch.device:
    """Where the texture field is evaluated: on the card that the guidance's networks are on, else on the CPU.

    The part's sdf stays on the CPU, where the surface is extracted from it.
    """
    device = torch.device(own_device(config.device))
    return device if device.type == "cuda" else torch.device("cpu")


def require_device(name: str, setting: str = "guidance.device") -> torch.device:
    """The torch device of a name: `cpu`, `cuda`, `cuda:1`, `mps`.

    Args:
        setting: what the user wrote the name in, for the message.

    Raises:
        UserError: no such kind of device, torch was built without it, or this machine has no such device.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(f"{setting} = {name!r}: torch knows no such device; take cpu or cuda") from None
    if device.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if count <= (device.index or 0):
            found = f"{count} CUDA device{'' if count == 1 else 's'}"
            raise UserError(
                f"{setting} = {name!r}: torch {torch.__version__} finds {found}; set {setting} to cpu, or "
                "install a driver and a CUDA build of torch"
            )
    if device.type == "mps" and not torch.backends.mps.is_available():
        raise UserError(f"{setting} = {name!r}: torch {torch.__version__} finds no Apple GPU; set {setting} to cpu")
    return device
