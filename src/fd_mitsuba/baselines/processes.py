"""A comparison's jobs as processes of a batch: several at a time, and a crash of one is that one's alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fd_mitsuba.baselines.jobs import CompareJob, finished_result
from fd_mitsuba.baselines.measuring import CompareProtocol
from fd_mitsuba.batch.job import PROGRAM, Job
from fd_mitsuba.batch.local import Outcome, run_batch
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.similarity import Judge


@dataclass(frozen=True)
class CompareProcess(Job):
    """One scene by one method with one seed: what `fd_mitsuba compare --one` is given."""

    method: str = ""
    """As for `--methods`."""
    judge: str | None = None
    """As for `--judge`."""
    views: int = 24
    size: int = 96
    variant: str | None = None
    """As for `-m`."""

    def words(self, threads: int) -> list[str]:
        """Arguments for the command line."""
        words = ["compare", "--one", str(self.scene.resolve()), "--methods", self.method, "--seeds", str(self.seed)]
        words += [*self.settings_words(), "--views", str(self.views), "--size", str(self.size)]
        for item in self.definitions:
            words += ["-D", item]
        words += [] if self.judge is None else ["--judge", self.judge]
        words += [] if self.variant is None else ["-m", self.variant]
        return [*words, "-o", str(self.folder.resolve().parent), "-t", str(threads)]

    def is_finished(self) -> bool:
        """The process itself looks, for it knows the settings; those that are finished get none."""
        return False


def run_processes(
    jobs: Sequence[CompareJob],
    process_of: Callable[[CompareJob], CompareProcess],
    judge: Judge,
    protocol: CompareProtocol,
    folder: Path,
    workers: int,
    threads: int | None,
    say: Callable[[str], None],
    program: tuple[str, ...] = PROGRAM,
) -> list[Outcome]:
    """Do what is missing as processes, `workers` at a time, with their record in `folder/batch.json`.

    Args:
        threads: of each; None: the cores, shared out.

    Raises:
        UserError: as `run_batch`.
    """
    missing = []
    for job in jobs:
        try:
            found = finished_result(job, judge, protocol)
        except UserError:
            found = None
        if found is None:
            missing.append(process_of(job))
    if not missing:
        return []
    return run_batch(missing, workers, say, threads=threads, record=folder / "batch.json", program=program)
