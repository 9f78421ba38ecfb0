"""Work that is wanted often and done rarely: some time after the last request, one at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future


class Debounced:
    """Calls `work` in `executor`, `seconds` after the last call of this object.

    What is asked for while `work` goes on is done afterwards, once.
    """

    def __init__(self, work: Callable[[], None], executor: Executor, seconds: float = 0.4) -> None:
        self._work, self._executor, self._seconds = work, executor, seconds
        self._lock, self._timer = threading.Lock(), None
        self._pending: Future[None] | None = None

    def __call__(self) -> None:
        with self._lock:
            self._cancel()
            self._timer = threading.Timer(self._seconds, self._fire)
            self._timer.daemon = True
            self._timer.start()

    def close(self) -> None:
        """Forget what was asked for."""
        with self._lock:
            self._cancel()

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._pending is not None:
            self._pending.cancel()  # it has not begun, and a newer request is on its way

    def _fire(self) -> None:
        with self._lock:
            try:
                self._pending = self._executor.submit(self._work)
            except RuntimeError:  # the executor was shut down meanwhile
                self._pending = None
