"""Undo and redo of what a person does to regions and prompt."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose

_MOST = 200
_ONE_MOVE_SECONDS = 1.0
"""Changes of one kind that follow each other sooner are one, such as all places of a region that is dragged."""


@dataclass(frozen=True)
class Snapshot:
    """What can be brought back: regions in their order, which of them is selected, and the prompt."""

    poses: tuple[EllipsoidPose, ...]
    selected: str
    prompt: str


class History:
    """Snapshots from before each change.

    Args:
        clock: seconds, of any start.

    Example:
        history.before("move wing", snapshot)  # then change the state
        snapshot = history.undo(now)  # what to go back to; None: nothing
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._past: list[Snapshot] = []
        self._future: list[Snapshot] = []
        self._kind, self._last = "", 0.0

    def before(self, kind: str, snapshot: Snapshot) -> None:
        """Remember what is, because a change of some kind is about to come."""
        now = self._clock()
        goes_on = kind == self._kind and now - self._last < _ONE_MOVE_SECONDS and not self._future
        self._kind, self._last = kind, now
        if goes_on and self._past:
            return
        self._past = [*self._past, snapshot][-_MOST:]
        self._future = []

    def undo(self, now: Snapshot) -> Snapshot | None:
        """The state before the last change, given that which is now."""
        return self._step(self._past, self._future, now)

    def redo(self, now: Snapshot) -> Snapshot | None:
        """The state that the last undo left."""
        return self._step(self._future, self._past, now)

    def clear(self) -> None:
        """Forget everything, as for a new base."""
        self._past, self._future, self._kind = [], [], ""

    def _step(self, source: list[Snapshot], target: list[Snapshot], now: Snapshot) -> Snapshot | None:
        self._kind = ""
        while source:
            found = source.pop()
            if found != now:  # a change that changed nothing is none
                target.append(now)
                return found
        return None
