"""The studio without a browser: the scene, its regions and prompt, the runs; what a person can do with them.

session = Session(opened, settings)
session.subscribe(print)                # hears "regions", "check", "runs", ...
session.start()
session.add_at(origin, direction)       # a click on the base
session.set_prompt("a cat with a horn")
name = session.grow()                   # queued; `session.queue` does it
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.debounce import Debounced
from fd_mitsuba.studio.edit_state import EditState
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.history import History, Snapshot
from fd_mitsuba.studio.job import RunOrder
from fd_mitsuba.studio.live_check import LiveCheck, live_check
from fd_mitsuba.studio.opening import Opened
from fd_mitsuba.studio.picking import first_hit
from fd_mitsuba.studio.plain_text import without_paths
from fd_mitsuba.studio.queue import PROGRAM, RunQueue
from fd_mitsuba.studio.region_list import LONGEST_PROMPT, RegionList
from fd_mitsuba.studio.run_state import FINISHED
from fd_mitsuba.studio.settings import StudioSettings

Listener = Callable[[str], None]


class Session:
    """All of the studio's state; every method may be called from any thread.

    Args:
        opened: what to work on.
        settings: of runs, where the work folder has none yet.
        threads, variant: of runs, as for `-t` and `-m`.
        program: see `RunQueue`.
        say: takes lines for the terminal.

    Attributes:
        lock: held for moments only; listeners are called with it or without it. Mitsuba reads scenes for one thread at
            a time, under a lock of its own that nobody waits for while holding this one.
        state: scene, regions, prompt, settings.
        queue: the runs.
        check: the newest check; None: there is none yet.
        shown: name of the run that the page shows, "" for none.
        beside: name of a finished run that is shown beside it, to compare; "" for none.

    Raises:
        UserError: the work folder or its scene cannot be read or written.
    """

    def __init__(
        self,
        opened: Opened,
        settings: StudioSettings,
        threads: int = 0,
        variant: str = "llvm_ad_rgb",
        program: Sequence[str] = PROGRAM,
        say: Callable[[str], None] = print,
    ) -> None:
        self.lock, self._mitsuba = threading.RLock(), threading.Lock()
        self.work, self._threads, self._variant = opened.work, threads, variant
        self._listeners: list[Listener] = []
        self.state = EditState.open(opened, settings, say)
        self.check: LiveCheck | None = None
        self.executor = ThreadPoolExecutor(1, "studio-work")
        self._recheck = Debounced(self._check_in_turn, self.executor)
        self.queue = RunQueue(self.work.runs, lambda name: self._tell("runs"), program)
        for folder in [*self.work.adopted(), *([opened.run] if opened.run is not None else [])]:
            self.queue.adopt(folder)
        self.shown = opened.shown or next(reversed(self.queue.runs), "")
        self.beside = ""
        self._history = History()
        self.save()

    def subscribe(self, listener: Listener) -> None:
        """Call `listener` with a topic whenever something has changed: `scene`, `regions`, `pose`, `selected`,
        `prompt`, `settings`, `check`, `runs`."""
        self._listeners.append(listener)

    def unsubscribe(self, listener: Listener) -> None:
        """Call a listener no more."""
        self._listeners = [other for other in self._listeners if other != listener]

    def start(self) -> None:
        """Begin to check and to run what is queued."""
        self.queue.start()
        self._recheck()

    def close(self) -> None:
        """Stop the present run with its state saved, and end."""
        self._recheck.close()
        self.queue.close()
        self.executor.shutdown(wait=True, cancel_futures=True)
        self.save()

    # Regions

    def select(self, name: str) -> None:
        """Make a region the one that gizmo and fields are for."""
        with self.lock:
            self.state.regions.pose(name)
            self.state.selected = name
        self._tell("selected")

    def put(self, pose: EllipsoidPose) -> None:
        """Change a region: its place, turn, radii, part; UserError as `RegionList.put`."""
        with self.lock:
            if self.state.regions.pose(pose.name) == pose:
                return  # a field that only echoes what the model has told it
            before = self._snapshot()
            self.state.regions.put(pose)
            self._history.before(f"put {pose.name}", before)
        self._tell("pose", check=True)

    def add_at(self, origin: Sequence[float], direction: Sequence[float]) -> str | None:
        """A new region where a ray of the canonical frame meets the base; its name, or None where it does not."""
        hit = first_hit(self.state.base, np.array(origin), np.array(direction))
        return None if hit is None else self._chosen(lambda regions: regions.add_at(hit))

    def add(self) -> str:
        """A new region on top of the base's middle; its name."""
        vertices = self.state.base.vertices
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
        with self.lock:
            before = self._snapshot()
            self.state.regions.remove(name)
            self._history.before("remove", before)
            self.state.selected = next(iter(self.state.regions.poses), "")
        self._tell("regions", check=True)

    def _chosen(self, made: Callable[[RegionList], EllipsoidPose]) -> str:
        with self.lock:
            before = self._snapshot()
            self.state.selected = name = made(self.state.regions).name
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
        state = self.state
        return Snapshot(tuple(state.regions.poses.values()), state.selected, state.prompt)

    def _return_to(self, step: Callable[[Snapshot], Snapshot | None], otherwise: str) -> None:
        with self.lock:
            found = step(self._snapshot())
            if found is None:
                raise UserError(otherwise)
            self.state.regions.poses = {pose.name: pose for pose in found.poses}
            self.state.selected, self.state.prompt = found.selected, found.prompt
        self._tell("prompt")
        self._tell("regions", check=True)

    # Prompt and settings

    def set_prompt(self, prompt: str) -> None:
        """The sentence for the next run; blank: none can be started. UserError where it is far too long."""
        words = " ".join(prompt.split())
        if len(words) > LONGEST_PROMPT:
            raise UserError(f"the prompt has {len(words)} letters; at most {LONGEST_PROMPT} are possible")
        with self.lock:
            if words == self.state.prompt:
                return
            self._history.before("prompt", self._snapshot())
            self.state.prompt = words
        self._tell("prompt", check=True)

    def set_settings(self, **changed: Any) -> None:
        """Other values for `StudioSettings`; UserError where one is out of range, and all stays as it was."""
        with self.lock:
            settings = replace(self.state.settings, **changed)
            if settings == self.state.settings:
                return
            settings.config()
            self.state.settings = settings
        self._tell("settings", check=True)

    def check_now(self) -> LiveCheck:
        """Check what there is, and remember it; the answer is out of date when something changes meanwhile."""
        with self.lock:
            scene, config = self.state.edited_scene(), self.state.settings.config()
        with self._mitsuba:
            result = live_check(scene, config)
        with self.lock:
            self.check = result
            self.save()
        self._tell("check")
        return result

    def _check_in_turn(self) -> None:
        try:
            self.check_now()
        except UserError as error:
            self.check = LiveCheck(str(error))
            self._tell("check")
        except Exception:
            traceback.print_exc()
            self.check = LiveCheck("the check failed; the terminal has more about it")
            self._tell("check")

    # Runs

    def grow(self, seed: int | None = None) -> str:
        """Queue a run of what there is now; its name. UserError for what the check refuses."""
        if seed is not None:
            self.set_settings(seed=seed)
        refusal = self.check_now().refusal
        if refusal is not None:
            raise UserError(refusal)
        with self.lock:
            state, folder = self.state, self.work.next_run()
            snapshot = state.source.snapshot(folder.name, state.scene_text(state.source.text))
            config = state.settings.config().model_dump(mode="json")
            order = RunOrder(
                self.work.relative(snapshot, folder),
                state.prompt,
                config,
                state.source.parameters,
                self._threads,
                self._variant,
            )
            self.shown = folder.name
            self.save()
        return self.queue.add(folder, order)

    def another_seed(self) -> str:
        """Queue the same with the next seed that no run has used yet; its name."""
        used = {run.seed for run in self.queue.runs.values()} | {self.state.settings.seed}
        return self.grow(max(used) + 1)

    def show(self, name: str) -> None:
        """Let the page show a run; "" for none."""
        with self.lock:
            if name and name not in self.queue.runs:
                raise UserError(f"run {name}: is not there")
            self.shown = name
        self._tell("runs")

    def compare(self, name: str) -> None:
        """Let the page show the result of a run beside the other; "" for none; UserError where it has none yet."""
        with self.lock:
            run = self.queue.runs.get(name)
            if name and (run is None or run.state != FINISHED):
                raise UserError(f"run {name}: has no result yet; let it finish first")
            self.beside = name
        self._tell("runs")

    def save_scene(self) -> str:
        """See `EditState.save_scene`."""
        with self._mitsuba:
            said = self.state.save_scene()
        self.save()
        return said

    def edit_again(self, name: str) -> None:
        """Make the result of a run the base of a new round; UserError as `EditState.next_round`."""
        run = self.queue.runs.get(name)
        if run is None:
            raise UserError("there is no run yet; grow a part first")
        with self._mitsuba:
            state = self.state.next_round(run)
        self._begin_round(state)

    def open_mesh(self, path: Path) -> list[str]:
        """Make a mesh file the base of a new round, with a region on its head; what was guessed, a line each.

        Raises:
            UserError: it cannot be read or edited; all stays as it was.
        """
        with self._mitsuba:
            state, said = self.state.of_mesh(path)
        self._begin_round(state)
        return said

    def _begin_round(self, state: EditState) -> None:
        with self.lock:
            self.state, self.shown, self.beside, self.check = state, "", "", None
            self._history.clear()
            self.save()
        self._tell("scene", check=True)

    def plain(self, text: str) -> str:
        """The text without paths of this machine."""
        return without_paths(text, self.work.path, self.state.source.original.parent, Path.cwd(), Path.home())

    def save(self) -> None:
        """Write the record of the work folder."""
        with self.lock:
            self.state.write([self.work.relative(folder) for folder in self.queue.adopted])

    def _tell(self, topic: str, check: bool = False) -> None:
        if check:
            self._recheck()
        for listener in list(self._listeners):
            listener(topic)
