"""Many runs: scenes by settings by seeds, on this machine or on a Ray cluster; what is finished is not done again.

jobs = job_matrix([Path("scenes/cat/scene.xml")], [Path("quick")], [0, 1, 2], (), Path("runs/cats"))
outcomes = run_batch(jobs, workers=2, record=Path("runs/cats/batch.json"))
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType

from fd_mitsuba.backend.threads import available_cores
from fd_mitsuba.batch.job import FAILED, INTERRUPTED, KILLED, PROGRAM, Job, Outcome, is_finished, perform
from fd_mitsuba.batch.record import write_record
from fd_mitsuba.config import settings_for_run
from fd_mitsuba.errors import UserError

MOST_WORKERS, MOST_RETRIES = 1024, 100

__all__ = ["Job", "Outcome", "is_finished", "job_matrix", "run_batch", "scene_name"]


def scene_name(scene: Path) -> str:
    """What a scene file is called: its folder's name if it is a `scene.xml`, else its own."""
    return scene.resolve().parent.name if scene.stem == "scene" else scene.stem


def job_matrix(
    scenes: Sequence[Path],
    configs: Sequence[Path | None],
    seeds: Sequence[int] | None,
    overrides: Sequence[str],
    folder: Path,
    definitions: Sequence[str] = (),
    stage: str = "all",
    plugins: Sequence[str] = (),
) -> list[Job]:
    """A job for each scene, settings file and seed, in `folder/<scene>-<config>-<seed>`.

    Args:
        scenes: scene files, or folders with a `scene.xml`.
        configs: settings files; None: the defaults.
        seeds: None: the one in the settings.
        plugins: as for `--plugin`.

    Raises:
        UserError: a file is missing or its settings are wrong, or two jobs would share a folder.
    """
    jobs: dict[str, Job] = {}
    for given in scenes:
        scene = given / "scene.xml" if given.is_dir() else given
        if not scene.is_file():
            raise UserError(f"{scene}: no such scene; give a scene file or a folder with a scene.xml")
        for config in configs or [None]:
            probe = Job(scene, config, 0, tuple(overrides), folder, tuple(definitions), stage, plugins=tuple(plugins))
            for seed in seeds if seeds is not None else [_own_seed(probe)]:
                name = f"{scene_name(scene)}-{'default' if config is None else config.stem}-{seed}"
                if name in jobs:
                    raise UserError(f"{name}: two jobs of this batch have this name; rename a scene or a config file")
                jobs[name] = replace(probe, seed=seed, folder=folder / name)
                jobs[name].settings()
    return list(jobs.values())


def run_batch(
    jobs: Sequence[Job],
    workers: int = 1,
    say: Callable[[str], None] = print,
    ray_address: str | None = None,
    *,
    retries: int = 1,
    threads: int | None = None,
    record: Path | None = None,
    program: tuple[str, ...] = PROGRAM,
) -> list[Outcome]:
    """Run the jobs, each as a process of its own, and return what became of them, in their order.

    What is finished is skipped, what was begun goes on. A run that fails leaves the others alone; one that is killed by
    a signal is taken up again `retries` times. SIGINT and SIGTERM (in the main thread) let every run save its state.

    Args:
        workers: runs at a time; on a Ray cluster that is there already, Ray decides.
        say: takes a line for each outcome.
        ray_address: None: without Ray. `local`: a Ray of this batch's own on this machine. Else: a cluster's address.
        threads: cores for a run; None: this machine's, shared among the workers.
        record: a JSON file that is kept up to date; rows of jobs of earlier batches stay in it.
        program: the command line's first words.

    Raises:
        UserError: two jobs with one folder, settings that cannot be read, Ray missing or not reached.
    """
    if workers < 1 or retries < 0:
        raise UserError(f"--workers {workers} --retries {retries}: give at least 1 worker and no negative number")
    if workers > MOST_WORKERS or retries > MOST_RETRIES:
        raise UserError(f"--workers {workers} --retries {retries}: give at most {MOST_WORKERS} and {MOST_RETRIES}")
    if len({job.folder.resolve() for job in jobs}) < len(jobs):
        raise UserError("two jobs of the batch have one folder; give each its own")
    _check_names(jobs, program)
    threads = threads or max(1, available_cores() // workers)
    outcomes: dict[Job, Outcome] = {}

    def done(outcome: Outcome) -> None:
        outcomes[outcome.job] = outcome
        again = f" (attempt {outcome.attempts})" if outcome.attempts > 1 else ""
        say(f"[{len(outcomes)}/{len(jobs)}] {outcome.job.name}: {_spoken(outcome)}{again}")
        if record is not None:
            write_record(record, jobs, outcomes)

    token = f"batch {time.time_ns()}-{os.getpid()}"
    with _stop_requests() as stops:
        if record is not None:
            write_record(record, jobs, outcomes)
        if ray_address is None:
            _run_here(jobs, workers, lambda job: _persistently(job, token, threads, program, stops, retries, say), done)
        else:
            from fd_mitsuba.batch.ray import run_with_ray

            run_with_ray(jobs, workers, threads, retries, ray_address, token, program, stops, done)
    return [outcomes[job] for job in jobs]


def _check_names(jobs: Sequence[Job], program: tuple[str, ...]) -> None:
    """UserError where settings cannot be read, or name what is not registered or give it wrong options.

    Names are looked up by a process of its own, and only where there are any besides the defaults: it loads torch.
    """
    naming = {}
    for job in jobs:
        if job.settings().names_entries:
            naming[job.config, job.overrides, job.plugins] = job
    for job in naming.values():
        command = [*program, "names", *job.settings_words(), "--json"]
        result = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
        if result.returncode:
            last = (result.stderr.strip().splitlines() or [f"{' '.join(command)} failed"])[-1]
            raise UserError(last.removeprefix("fd_mitsuba: error: "))


def _run_here(
    jobs: Sequence[Job], workers: int, work: Callable[[Job], Outcome], done: Callable[[Outcome], None]
) -> None:
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(work, job): job for job in jobs}
        for future in as_completed(futures):
            try:
                done(future.result())
            except (OSError, UserError) as error:
                done(Outcome(futures[future], FAILED, str(error)))


def _persistently(
    job: Job,
    token: str,
    threads: int,
    program: tuple[str, ...],
    stops: Callable[[], int],
    retries: int,
    say: Callable[[str], None],
) -> Outcome:
    if stops():
        return Outcome(job, INTERRUPTED, "not started")
    outcome = perform(job, token, threads, program, stops)
    for _ in range(retries):
        if outcome.state == KILLED and not stops():
            say(f"{job.name}: {outcome.message}; taken up again")
            outcome = perform(job, token, threads, program, stops)
    return replace(outcome, state=FAILED) if outcome.state == KILLED else outcome


@contextmanager
def _stop_requests() -> Iterator[Callable[[], int]]:
    """How often SIGINT or SIGTERM has come since; outside the main thread they are left alone."""
    count = 0

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal count
        count += 1
        if count == 1:
            os.write(2, b"fd_mitsuba: stopping: each run saves its state; once more kills them\n")

    if threading.current_thread() is not threading.main_thread():
        yield lambda: 0
        return
    old = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: count
    finally:
        for number, handler in old.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _own_seed(job: Job) -> int:
    return settings_for_run(job.config, job.overrides).config.seed


def _spoken(outcome: Outcome) -> str:
    took = f" in {outcome.seconds:.0f} s" if outcome.state == "finished" and outcome.seconds else ""
    return f"{outcome.state}{took}{': ' + outcome.message if outcome.message else ''}"
