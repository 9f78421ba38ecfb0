"""What a person changes: regions, prompt, settings of the next run; with undo and redo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.prompt_text import length_fault, one_line_of
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.history import History, Snapshot
from fd_mitsuba.studio.picking import first_hit
from fd_mitsuba.studio.region_list import RegionList

if TYPE_CHECKING:
    from fd_mitsuba.studio.edit_state import EditState
    from fd_mitsuba.studio.session import Session


class Edits:
    """Changes of a session's state, each of which is told to the page and checked.

    Args:
        session: whose state it is; its lock is held while something changes.
    """

    def __init__(self, session: Session) -> None:
        self._session, self._lock, self._tell = session, session.lock, session.tell
        self._history = History()

    @property
    def _state(self) -> EditState:
        return self._session.state

    def forget(self) -> None:
        """Nothing can be undone any more: another round has begun."""
        self._history.clear()

    def select(self, name: str) -> None:
        """Make a region the one that gizmo and fields are for."""
        with self._lock:
            self._state.regions.pose(name)
            self._state.selected = name
        self._tell("selected")

    def put(self, pose: EllipsoidPose) -> None:
        """Change a region: its place, turn, radii, part; UserError as `RegionList.put`."""
        with self._lock:
            if self._state.regions.pose(pose.name) == pose:
                return  # a field that only echoes what the model has told it
            before = self._snapshot()
            self._state.regions.put(pose)
            self._history.before(f"put {pose.name}", before)
        self._tell("pose", check=True)

    def add_at(self, origin: Sequence[float], direction: Sequence[float]) -> str | None:
        """A new region where a ray of the canonical frame meets the base; its name, or None where it does not."""
        hit = first_hit(self._state.base, np.array(origin), np.array(direction))
        return None if hit is None else self._chosen(lambda regions: regions.add_at(hit))

    def add(self) -> str:
        """A new region on top of the base's middle; its name."""
        vertices = self._state.base.vertices
        x, y, z = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        above, down = np.array([x, vertices[:, 1].max() + 1, z]), np.array([0.0, -1.0, 0.0])
        if (name := self.add_at(above.tolist(), down.tolist())) is not None:
            return name
        return self._chosen(lambda regions: regions.add(above + down, -down))

    def mirror(self, name: str, axis: int = 0) -> str:
        """A copy on the other side of the base's middle; UserError where it would land on itself."""
        return self._chosen(lambda regions: regions.mirror(name, axis))

    def remove(self, name: str) -> None:
        """Take a region away; UserError for the last one."""
        with self._lock:
            before = self._snapshot()
            self._state.regions.remove(name)
            self._history.before("remove", before)
            self._state.selected = next(iter(self._state.regions.poses), "")
        self._tell("regions", check=True)

    def _chosen(self, made: Callable[[RegionList], EllipsoidPose]) -> str:
        with self._lock:
            before = self._snapshot()
            self._state.selected = name = made(self._state.regions).name
            self._history.before(f"add {name}", before)
        self._tell("regions", check=True)
        return name

    def undo(self) -> None:
        """Take the last change of regions or prompt back; UserError where there is none."""
        self._return_to(self._history.undo, "nothing to undo")

    def redo(self) -> None:
        """Make a change again that was undone; UserError where there is none."""
        self._return_to(self._history.redo, "nothing to redo")

    def _snapshot(self) -> Snapshot:
        state = self._state
        return Snapshot(tuple(state.regions.poses.values()), state.selected, state.prompt)

    def _return_to(self, step: Callable[[Snapshot], Snapshot | None], otherwise: str) -> None:
        with self._lock:
            found = step(self._snapshot())
            if found is None:
                raise UserError(otherwise)
            self._state.regions.poses = {pose.name: pose for pose in found.poses}
            self._state.selected, self._state.prompt = found.selected, found.prompt
        self._tell("prompt")
        self._tell("regions", check=True)

    def set_prompt(self, prompt: str) -> None:
        """The sentence for the next run; blank: none can be started. UserError where it is far too long.

        Regions that are as an import has put them, and nobody has touched, follow: see `EditState.follow_prompt`.
        """
        words = one_line_of(prompt)
        if fault := length_fault(words):
            raise UserError(f"the prompt {fault}")
        with self._lock:
            if words == self._state.prompt:
                return
            self._history.before("prompt", self._snapshot())
            before, self._state.prompt = self._state.prompt, words
            moved = self._state.follow_prompt(before)
        if moved:
            self._tell("regions")
        self._tell("prompt", check=True)

    def set_settings(self, **changed: Any) -> None:
        """Other values for `StudioSettings`; UserError where one is out of range, and all stays as it was."""
        with self._lock:
            settings = replace(self._state.settings, **changed)
            if settings == self._state.settings:
                return
            settings.config()
            self._state.settings = settings
        self._tell("settings", check=True)
