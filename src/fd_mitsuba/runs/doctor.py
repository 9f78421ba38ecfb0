"""What this machine offers a run, and what is missing, each in one line."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable
from importlib import metadata
from typing import NamedTuple

from fd_mitsuba.backend.startup import NO_CARD
from fd_mitsuba.backend.threads import available_cores
from fd_mitsuba.errors import UserError


class Finding(NamedTuple):
    """One line of the report; `ok` is False where a run would not work."""

    name: str
    ok: bool
    text: str


def examine() -> list[Finding]:
    """Look at Python, the CPU, LLVM, Mitsuba, torch and the built-in prior, in the order a run needs them."""
    return [
        Finding(
            "python",
            sys.version_info >= (3, 11),
            f"{platform.python_version()} ({platform.machine()}); 3.11 or newer is needed",
        ),
        Finding("cores", True, f"{available_cores()} of {os.cpu_count()} may be used"),
        _attempt("llvm", _llvm),
        _attempt("mitsuba", _mitsuba),
        Finding("rendering on a card", True, _card()),
        _attempt("torch", _torch),
        _attempt(
            "diffusers", lambda: f"{metadata.version('diffusers')}, transformers {metadata.version('transformers')}"
        ),
        _attempt("built-in prior", _prior),
        _attempt("memory", _memory),
    ]


def _attempt(name: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(name, True, look())
    except (UserError, ImportError, OSError, RuntimeError) as error:  # whatever it is, the report must go on
        return Finding(name, False, " ".join(str(error).split()))


def _llvm() -> str:
    from fd_mitsuba.backend.startup import find_llvm

    return str(find_llvm())


def _mitsuba() -> str:
    from fd_mitsuba.backend.startup import start

    mi = start()
    import drjit as dr

    total = dr.sum(dr.arange(mi.Float, 4))[0]
    if total != 6:
        raise UserError(f"a test kernel returned {total} instead of 6; reinstall mitsuba")
    return f"{mi.__version__}, variant {mi.variant()}, a test kernel ran"


def _card() -> str:
    """Nothing to mend where there is none: runs render on the CPU."""
    dr = sys.modules.get("drjit")  # imported with Mitsuba, unless that failed: a missing LLVM would be told twice
    if dr is None:
        return "unknown until Mitsuba starts"
    found = dr.has_backend(dr.JitBackend.CUDA)
    return "-m cuda_ad_rgb can be chosen; it was never tried" if found else NO_CARD


def _torch() -> str:
    import torch

    devices = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    found = f"cuda: {', '.join(devices)}" if devices else "no cuda device for guidance.device"
    return f"{torch.__version__}, {found}"


def _prior() -> str:
    from fd_mitsuba.guidance.builtin import builtin_folder

    folder = builtin_folder()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return f"{size / 1e6:.1f} MB in {folder}, hashes right"


def _memory() -> str:
    from fd_mitsuba.guidance.memory import available_bytes

    free = available_bytes()
    return "unknown" if free is None else f"{free / 1e9:.1f} GB available"
