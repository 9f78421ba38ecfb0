"""How the renderer and torch share the processor's cores and memory: decided in one place, before a run starts.

Both keep a pool of threads of their own, and a step hands over between them a few hundred times. Threads that wait by
spinning then take the core that the other pool needs: with both pools on two cores a step takes several times as long
as with one thread each. So

* OpenMP's idle threads sleep (`OMP_WAIT_POLICY=PASSIVE`, which counts only if it is set before torch is loaded);
* torch runs the small operations of a geometry step on one thread, and takes more only inside `network_threads()`,
  around a diffusion model;
* Dr.Jit stays on one thread where there are at most two cores: a second one made a quiet machine's step a fifth faster
  at best, and 1.5 to 2.7 times as slow as soon as anything else ran. With more cores it leaves one to the rest;
* steps with large pictures give both all cores, in turns (`step_threads`).

Each step also makes and drops arrays of some ten megabytes. The allocator is told to keep them instead of handing them
back to the system, which would clear them again page by page: 8 % of a step on the grid of 128 cells a side.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from fd_mitsuba.backend.processes import started_with_others
from fd_mitsuba.backend.startup import DEFAULT_VARIANT, start
from fd_mitsuba.errors import UserError

LARGE_PICTURES = 1 << 20
"""Samples of a step from which a second thread is worth more than it costs: four views of 512 pixels have them."""
_FEW_CORES = 2
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's mallopt
_KEPT_BYTES = 1 << 29
_cores: int | None = None


def share_cores(threads: int = 0, variant: str = DEFAULT_VARIANT) -> None:
    """Start Mitsuba, set all thread counts and the allocator. Call once per process, before anything imports torch.

    Args:
        threads: cores to use; 0: all that this process may run on. 1 gives every pool one thread, and so results that
            are the same bytes at every run.
        variant: Mitsuba's variant.

    Raises:
        UserError: more threads than `most_threads`, and as `startup.start`.
    """
    global _cores
    if threads > most_threads():
        raise UserError(f"-t {threads}: give 0 (all cores) or at most {most_threads()}, more only hinder each other")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    cores = threads or max(1, available_cores() // _local_processes())
    start(variant, threads if threads < 0 else renderer_threads(cores))
    import torch

    torch.set_num_threads(1)
    _cores = cores
    _keep_freed_memory()


@contextmanager
def own_threads(threads: int | None = None, variant: str = DEFAULT_VARIANT) -> Iterator[None]:
    """While open, thread counts are as `share_cores` sets them; then they are the caller's again.

    For functions that other people's code calls. That code may render and read files by itself, and with a single
    thread of Dr.Jit's, as two cores have it in a run, Mitsuba 3.9 waits forever when it reads or writes an EXR.

    Args:
        threads: as of `share_cores`; None: those of the call before, at first all cores.

    Raises:
        UserError: as `share_cores`.
    """
    before = _thread_counts()
    if threads is not None or _cores is None:
        share_cores(threads or 0, variant)
    else:
        _set_thread_counts(renderer_threads(_cores), 1)
    try:
        yield
    finally:
        _set_thread_counts(*before)


def _local_processes() -> int:
    """How many processes of the run are on this machine; they share its cores."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1")) if started_with_others() else 1


def available_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def most_threads() -> int:
    """The largest number of threads that is taken: each has a stack of its own, and the system has a limit."""
    return max(64, os.cpu_count() or 1)


def cores_in_use() -> int:
    """The cores given to `share_cores`; without that call the larger of the two pools."""
    if _cores is not None:
        return _cores
    import drjit as dr
    import torch

    return max(dr.thread_count(), torch.get_num_threads())


def renderer_threads(cores: int) -> int:
    """Dr.Jit's share of `cores`."""
    return 1 if cores <= _FEW_CORES else cores - 1


def lone_threads(count: int) -> ThreadPoolExecutor:
    """`count` threads in each of which torch works alone, whatever other threads ask of it meanwhile.

    >>> import torch
    >>> with lone_threads(1) as threads:
    ...     threads.submit(torch.get_num_threads).result()
    1
    """
    return ThreadPoolExecutor(count, initializer=_work_alone)


def _work_alone() -> None:
    import torch

    # A thread takes the process's latest number over at its first operation: without that being done here, a number
    # that another thread sets between now and then would be this one's too.
    torch.get_num_threads()
    torch.set_num_threads(1)


@contextmanager
def network_threads() -> Iterator[None]:
    """While open, torch uses all the cores given to `share_cores`; without that call nothing changes."""
    import torch

    with _all_cores(torch.get_num_threads, torch.set_num_threads):
        yield


@contextmanager
def rendering_threads() -> Iterator[None]:
    """While open, Dr.Jit has all the cores given to `share_cores`, for pictures that are rendered in one go.

    In the steps of a run a second thread of two is more in the way than it helps; a turntable takes 0.6 to 0.8 of the
    time with it, and shows the same.
    """
    import drjit as dr

    with _all_cores(dr.thread_count, dr.set_thread_count):
        yield


@contextmanager
def step_threads(samples: int) -> Iterator[None]:
    """While open, both pools have all the cores given to `share_cores`, for a step with large pictures.

    They take turns, and kernels of a tenth of a second and more are worth waking threads for. Steps with less than
    `LARGE_PICTURES` samples, as those of the built-in prior, keep their one thread.

    Args:
        samples: of all pictures of the step in this process.
    """
    if samples < LARGE_PICTURES:
        yield
        return
    with rendering_threads(), network_threads():
        yield


@contextmanager
def _all_cores(count: Callable[[], int], change: Callable[[int], None]) -> Iterator[None]:
    before = count()
    if _cores is not None:
        change(_cores)
    try:
        yield
    finally:
        change(before)


def _thread_counts() -> tuple[int, int]:
    """Dr.Jit's and torch's; where one is not loaded yet, what it will take, but two for files."""
    cores = max(2, available_cores())
    renderer, torch = sys.modules.get("drjit"), sys.modules.get("torch")
    return renderer.thread_count() if renderer else cores, torch.get_num_threads() if torch else cores


def _set_thread_counts(renderer: int, network: int) -> None:
    import drjit as dr
    import torch

    dr.set_thread_count(renderer)
    torch.set_num_threads(network)


def _keep_freed_memory() -> None:
    """Up to half a gigabyte stays with the process; an allocator other than glibc's is left as it is."""
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
