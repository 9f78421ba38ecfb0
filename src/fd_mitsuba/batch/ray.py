"""A batch on Ray: each run is a task that starts its process and waits for it."""

from __future__ import annotations

import importlib
import logging
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from fd_mitsuba.batch.job import FAILED, INTERRUPTED, KILLED, Job, Outcome, attempts, perform
from fd_mitsuba.errors import UserError

_CANCEL_SECONDS = 120.0


class RunKilled(Exception):
    """The run's process was ended by a signal: Ray tries the task again."""


def run_with_ray(
    jobs: Sequence[Job],
    workers: int,
    threads: int,
    retries: int,
    address: str,
    token: str,
    program: tuple[str, ...],
    stops: Callable[[], int],
    done: Callable[[Outcome], None],
) -> None:
    """Run the jobs as Ray tasks of `threads` CPUs; see `batch.run_batch`. Ray retries what is killed.

    On a cluster every machine needs the package and sees the scenes and the run folders under the same paths.

    Raises:
        UserError: Ray is not installed, or no cluster answers at the address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray's own report to its makers
    os.environ.setdefault("RAY_agent_register_timeout_ms", "120000")  # a busy machine starts slowly
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # it warns of a change that does not matter here
    try:
        ray: Any = importlib.import_module("ray")  # an extra: the type checker cannot count on it
    except ImportError:
        raise UserError("--ray: Ray is not installed; pip install 'fd_mitsuba[ray]', or leave --ray out") from None
    own = {"num_cpus": workers * threads, "include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=True, **own)
    except Exception as error:  # a start that takes too long is a bare Exception
        ray.shutdown()
        remedy = "free this machine" if address == "local" else "start one with ray start --head"
        raise UserError(f"--ray {address}: no Ray cluster reached ({error}); {remedy}, or leave --ray out") from None
    try:
        task = ray.remote(num_cpus=threads, max_retries=retries, retry_exceptions=[RunKilled])(_task)
        pending = {task.remote(job, token, threads, program): job for job in jobs}
        cancelled = None
        while pending:
            ready, _ = ray.wait(list(pending), timeout=0.5)
            for ref in ready:
                done(_outcome(ray, ref, pending.pop(ref), token, cancelled is not None))
            if stops() and cancelled is None:
                cancelled = time.monotonic()
                for ref in pending:
                    ray.cancel(ref)
            if stops() > 1 or (cancelled is not None and time.monotonic() - cancelled > _CANCEL_SECONDS):
                for job in pending.values():
                    done(Outcome(job, INTERRUPTED, "repeat the batch to go on"))
                break
    finally:
        ray.shutdown()


def _task(job: Job, token: str, threads: int, program: tuple[str, ...]) -> Outcome:
    """In a worker: run the job; a killed run is an exception, because that is what Ray retries."""
    outcome = perform(job, token, threads, program)
    if outcome.state == KILLED:
        raise RunKilled(outcome.message)
    return outcome


def _outcome(ray: Any, ref: Any, job: Job, token: str, cancelled: bool) -> Outcome:
    try:
        return ray.get(ref)
    except ray.exceptions.TaskCancelledError:
        return Outcome(job, INTERRUPTED, "repeat the batch to go on")
    except (ray.exceptions.RayError, RunKilled, OSError, UserError) as error:
        if cancelled:
            return Outcome(job, INTERRUPTED, "repeat the batch to go on")
        cause = getattr(error, "cause", None) or error
        message = " ".join(str(cause).split())[:500] or type(error).__name__
        return Outcome(job, FAILED, message, attempts=attempts(job, token))
