"""The studio without a browser: the scene, its regions and prompt, the runs; what a person can do with them.

session = Session(opened, settings)
session.subscribe(print)                # hears "regions", "check", "runs", ...
session.start()
session.edits.add_at(origin, direction) # a click on the base
session.edits.set_prompt("a cat with a horn")
name = session.grow()                   # queued; `session.queue` does it
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.checks import Checks
from fd_mitsuba.studio.edit_state import EditState
from fd_mitsuba.studio.edits import Edits
from fd_mitsuba.studio.job import RunOrder
from fd_mitsuba.studio.opening import Opened
from fd_mitsuba.studio.plain_text import without_paths
from fd_mitsuba.studio.queue import PROGRAM, RunQueue
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
        lock: held for moments only; listeners are called with it or without it.
        mitsuba: held while Mitsuba reads a scene, by one thread at a time; nobody waits for it while holding `lock`.
        state: scene, regions, prompt, settings.
        edits: changes of regions, prompt and settings.
        checks: what `check` says of them.
        queue: the runs.
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
        self.lock, self.mitsuba = threading.RLock(), threading.Lock()
        self.work, self._threads, self._variant = opened.work, threads, variant
        self._listeners: list[Listener] = []
        self.state = EditState.open(opened, settings, say)
        self.checks, self.edits = Checks(self), Edits(self)
        self.queue = RunQueue(self.work.runs, lambda name: self.tell("runs"), program)
        for folder in [*self.work.adopted(), *([opened.run] if opened.run is not None else [])]:
            self.queue.adopt(folder)
        self.shown = opened.shown or next(reversed(self.queue.runs), "")
        self.beside = ""
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
        self.checks.soon()

    def close(self) -> None:
        """Stop the present run with its state saved, and end."""
        self.checks.soon.close()
        self.queue.close()
        self.checks.close()
        self.save()

    def grow(self, seed: int | None = None) -> str:
        """Queue a run of what there is now; its name. UserError for what the check refuses."""
        if seed is not None:
            self.edits.set_settings(seed=seed)
        refusal = self.checks.now().refusal
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
        self.tell("runs")

    def compare(self, name: str) -> None:
        """Let the page show the result of a run beside the other; "" for none; UserError where it has none yet."""
        with self.lock:
            run = self.queue.runs.get(name)
            if name and (run is None or run.state != FINISHED):
                raise UserError(f"run {name}: has no result yet; let it finish first")
            self.beside = name
        self.tell("runs")

    def save_scene(self) -> str:
        """See `EditState.save_scene`."""
        with self.mitsuba:
            said = self.state.save_scene()
        self.save()
        return said

    def edit_again(self, name: str) -> None:
        """Make the result of a run the base of a new round; UserError as `EditState.next_round`."""
        run = self.queue.runs.get(name)
        if run is None:
            raise UserError("there is no run yet; grow a part first")
        with self.mitsuba:
            state = self.state.next_round(run)
        self._begin_round(state)

    def open_mesh(self, path: Path) -> list[str]:
        """Make a mesh file the base of a new round, with a region on its head; what was guessed, a line each.

        Raises:
            UserError: it cannot be read or edited; all stays as it was.
        """
        with self.mitsuba:
            state, said = self.state.of_mesh(path)
        self._begin_round(state)
        return said

    def _begin_round(self, state: EditState) -> None:
        with self.lock:
            self.state, self.shown, self.beside, self.checks.newest = state, "", "", None
            self.edits.forget()
            self.save()
        self.tell("scene", check=True)

    def plain(self, text: str) -> str:
        """The text without paths of this machine."""
        return without_paths(text, self.work.path, self.state.source.original.parent, Path.cwd(), Path.home())

    def save(self) -> None:
        """Write the record of the work folder."""
        with self.lock:
            self.state.write([self.work.relative(folder) for folder in self.queue.adopted])

    def tell(self, topic: str, check: bool = False) -> None:
        """Let all listeners know that something has changed; `check`: and check it before long."""
        if check:
            self.checks.soon()
        for listener in list(self._listeners):
            listener(topic)
