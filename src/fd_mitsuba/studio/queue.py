"""One run at a time, each a process of its own; the rest wait in their order."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run_folder import LIVE_FOLDER
from fd_mitsuba.studio.adopted_run import adopt
from fd_mitsuba.studio.job import RunOrder
from fd_mitsuba.studio.run_state import (
    FAILED,
    FINISHED,
    QUEUED,
    RESUMABLE,
    STARTING,
    STOPPED,
    STOPPING,
    RunState,
)

PROGRAM = (sys.executable, "-m", "fd_mitsuba.studio.runner")
_POLL_SECONDS = 0.2
_PATIENCE_SECONDS = 60.0
"""How long a run may take to save its state when the studio ends."""


class RunQueue:
    """The runs of a work folder, in the order in which they were made.

    Args:
        folder: holds the run folders; those that are there already are read.
        changed: called with the name of a run that has changed, from the queue's own thread.
        program: the first words of a run's command; its run folder comes behind them.
    """

    def __init__(
        self, folder: Path, changed: Callable[[str], None] = lambda name: None, program: Sequence[str] = PROGRAM
    ) -> None:
        self.folder, self._changed, self._program = folder, changed, tuple(program)
        self._lock = threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None
        self._current: str | None = None
        self._waiting: list[str] = []
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.runs: dict[str, RunState] = {}
        self.adopted: list[Path] = []
        for path in sorted(folder.glob("*")) if folder.is_dir() else []:
            if (path / LIVE_FOLDER / "job.json").is_file():
                with contextlib.suppress(UserError):
                    self._know(path).settled()

    def start(self) -> None:
        """Begin to run what waits, in a thread of the queue's own."""
        self._thread = threading.Thread(target=self._serve, name="studio-queue", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let the present run save its state, and wait for that; what waits stays as it is."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
        with self._lock:
            process = self._process
        if process is not None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(_PATIENCE_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def add(self, folder: Path, order: RunOrder) -> str:
        """Put a run at the end of the queue; its name."""
        order.write(folder)
        with self._lock:
            run = self._know(folder)
            run.state = QUEUED
            self._waiting.append(run.name)
        self._changed(run.name)
        return run.name

    def resume(self, name: str) -> None:
        """Let a run that stopped or failed go on, when its turn comes; UserError for any other."""
        with self._lock:
            run = self.runs[name]
            if run.state not in RESUMABLE:
                raise UserError(f"run {name}: is {run.state}; only a run that stopped can go on")
            replace(RunOrder.read(run.folder), resume=True).write(run.folder)
            run.state, run.line = QUEUED, ""
            self._waiting.append(name)
        self._changed(name)

    def stop(self, name: str) -> None:
        """Let a run finish its step and save; one that waits is taken out of the queue. A second call kills it."""
        with self._lock:
            run = self.runs[name]
            if name in self._waiting:
                self._waiting.remove(name)
                run.state = STOPPED
            elif name == self._current and self._process is not None:
                self._process.send_signal(signal.SIGINT if run.state != STOPPING else signal.SIGKILL)
                run.state = STOPPING
        self._changed(name)

    def adopt(self, folder: Path) -> None:
        """Take in a run that was made elsewhere; UserError where it cannot be gone on with."""
        if folder.name in self.runs:
            return
        adopt(folder)
        self._know(folder).settled()
        self.adopted.append(folder)

    @property
    def current(self) -> RunState | None:
        """The run that a process works on."""
        with self._lock:
            return None if self._current is None else self.runs[self._current]

    @property
    def waiting(self) -> list[str]:
        """Names of the runs that wait, the next one first."""
        with self._lock:
            return list(self._waiting)

    def step(self) -> None:
        """Look after the present run once, or start the next; the queue's thread calls it some times a second."""
        with self._lock:
            if self._process is None and self._waiting:
                self._begin(self._waiting.pop(0))
                name, news = self._current, True
            elif self._process is not None:
                name = self._current
                code = self._process.poll()
                news = self.runs[str(name)].follow()
                if code is not None:
                    self._end(str(name), code)
                    news = True
            else:
                return
        if news and name is not None:
            self._changed(name)

    def _serve(self) -> None:
        while not self._ended.wait(_POLL_SECONDS):
            self.step()

    def _know(self, folder: Path) -> RunState:
        order = RunOrder.read(folder)
        run = RunState(folder, int(order.config.get("seed") or 0), order.prompt)
        self.runs[folder.name] = run
        return run

    def _begin(self, name: str) -> None:
        run = self.runs[name]
        run.state, run.line = STARTING, ""
        log = run.folder / LIVE_FOLDER / "log.txt"
        with open(log, "ab") as output:
            # A session of its own: Ctrl-C in the terminal reaches the studio alone, which then asks the run.
            self._process = subprocess.Popen(
                [*self._program, str(run.folder)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
        self._current = name

    def _end(self, name: str, code: int) -> None:
        run = self.runs[name]
        run.follow()
        if code == 0 and run.finished_on_disk:
            run.state = FINISHED
        elif run.state != FAILED:
            run.state = STOPPED if code in (130, 0) or code < 0 else FAILED
            if run.state == FAILED and not run.line:
                run.line = f"the run ended with exit code {code}; its folder has a log"
        self._process, self._current = None, None
