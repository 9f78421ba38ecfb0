"""Evaluate many runs with several processes: most of an evaluation runs on one core."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

from fd_mitsuba.backend.threads import available_cores
from fd_mitsuba.batch.job import PROGRAM


def evaluate_at_once(
    runs: Sequence[Path], workers: int, options: Sequence[str] = (), program: tuple[str, ...] = PROGRAM
) -> bool:
    """Let `workers` processes evaluate their shares of the runs; True if nothing went wrong in any.

    What they find is in the runs' folders, where `evaluate_run` takes it from. They say nothing: whoever then asks
    for a run that could not be evaluated hears why.

    Args:
        options: of the command `evaluate`, for all of them.
        program: the command line's first words.
    """
    workers = min(workers, len(runs))
    threads = max(1, available_cores() // workers)
    processes = []
    try:
        for share in filter(None, (runs[first::workers] for first in range(workers))):
            command = [*program, "evaluate", *map(str, share), *options, "-t", str(threads)]
            processes.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        return all([process.wait() == 0 for process in processes])
    finally:  # also when this process is stopped
        for process in processes:
            if process.poll() is None:
                process.terminate()
                process.wait()
