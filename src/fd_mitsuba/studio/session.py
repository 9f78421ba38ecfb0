"""The studio without a browser: the scene, its regions and prompt, the runs; what a person can do with them.

session = Session(opened, settings)
session.add_at(origin, direction)       # a click on the base
session.set_prompt("a cat with a horn")
name = session.grow()                   # queued; `session.queue` does it
session.subscribe(print)                # hears "regions", "check", "runs", ...
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.edit_scene import EditScene, load_edit_scene
from fd_mitsuba.studio.base_glb import base_glb
from fd_mitsuba.studio.debounce import Debounced
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.job import RunOrder
from fd_mitsuba.studio.live_check import LiveCheck, live_check
from fd_mitsuba.studio.opening import Opened
from fd_mitsuba.studio.picking import first_hit
from fd_mitsuba.studio.plain_text import without_paths
from fd_mitsuba.studio.queue import PROGRAM, RunQueue
from fd_mitsuba.studio.region_list import RegionList
from fd_mitsuba.studio.scene_patch import patched
from fd_mitsuba.studio.scene_source import SceneSource
from fd_mitsuba.studio.settings import StudioSettings

_LONGEST_PROMPT = 1000
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
        scene: as it was opened; regions and prompt are those of this object.
        base_glb: the base as the page shows it, user frame.
        regions, prompt, settings, selected: what the page shows.
        check: the newest check; None: it is being made.
        shown: name of the run that the page shows, "" for none.

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
        self.work, self._threads, self._variant, self._say = opened.work, threads, variant, say
        self._listeners: list[Listener] = []
        record = self.work.read()
        self.source = SceneSource.opened(opened, record, say)
        self.scene = self.source.load(_prompt_of(opened, record))
        self.base_glb = base_glb(self.scene)
        self.settings, self.prompt = settings, self.scene.prompt
        self._take_scene()
        if record is not None and not self.source.renewed:
            self._restore(record, settings)
        self.check: LiveCheck | None = None
        self.executor = ThreadPoolExecutor(1, "studio-work")
        self._recheck = Debounced(self.check_now, self.executor)
        self.queue = RunQueue(self.work.runs, self._run_changed, program)
        self.shown = opened.shown or next(reversed(self.queue.runs), "")
        self.save()

    def subscribe(self, listener: Listener) -> None:
        """Call `listener` with a topic whenever something has changed: `scene`, `regions`, `pose`, `selected`,
        `prompt`, `settings`, `check`, `runs`."""
        self._listeners.append(listener)

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
            self.regions.pose(name)
            self.selected = name
        self._tell("selected")

    def put(self, pose: EllipsoidPose) -> None:
        """Change a region: its place, turn, radii, part; UserError as `RegionList.put`."""
        with self.lock:
            if self.regions.pose(pose.name) == pose:
                return  # a field that only echoes what the model has told it
            self.regions.put(pose)
        self._tell("pose", check=True)

    def add_at(self, origin: Sequence[float], direction: Sequence[float]) -> str | None:
        """A new region where a ray of the canonical frame meets the base; its name, or None where it does not."""
        hit = first_hit(self.scene.base_canonical, np.array(origin), np.array(direction))
        if hit is None:
            return None
        with self.lock:
            return self._chosen(self.regions.add_at(hit).name)

    def add(self) -> str:
        """A new region on top of the base's middle; its name."""
        low, high = (
            np.min(self.scene.base_canonical.vertices, axis=0),
            np.max(self.scene.base_canonical.vertices, axis=0),
        )
        above = np.array([(low[0] + high[0]) / 2, high[1] + 1, (low[2] + high[2]) / 2])
        hit = first_hit(self.scene.base_canonical, above, np.array([0.0, -1.0, 0.0]))
        with self.lock:
            top = np.array([above[0], high[1], above[2]])
            pose = self.regions.add(top, np.array([0.0, 1.0, 0.0])) if hit is None else self.regions.add_at(hit)
            return self._chosen(pose.name)

    def mirror(self, name: str, axis: int = 0) -> str:
        """A copy on the other side of the base's middle; UserError where it would land on itself."""
        with self.lock:
            return self._chosen(self.regions.mirror(name, axis).name)

    def remove(self, name: str) -> None:
        """Take a region away; UserError for the last one."""
        with self.lock:
            self.regions.remove(name)
            self.selected = next(iter(self.regions.poses), "")
        self._tell("regions", check=True)

    def _chosen(self, name: str) -> str:
        self.selected = name
        self._tell("regions", check=True)
        return name

    # Prompt and settings

    def set_prompt(self, prompt: str) -> None:
        """The sentence for the next run; UserError where it is blank or far too long."""
        words = " ".join(prompt.split())
        if not words:
            raise UserError("the prompt is blank; describe the edited object")
        if len(words) > _LONGEST_PROMPT:
            raise UserError(f"the prompt has {len(words)} letters; at most {_LONGEST_PROMPT} are possible")
        with self.lock:
            if words == self.prompt:
                return
            self.prompt = words
        self._tell("prompt", check=True)

    def set_settings(self, **changed: Any) -> None:
        """Other values for `StudioSettings`; UserError where one is out of range, and all stays as it was."""
        with self.lock:
            settings = replace(self.settings, **changed)
            if settings == self.settings:
                return
            settings.config()
            self.settings = settings
        self._tell("settings", check=True)

    def check_now(self) -> LiveCheck:
        """Check what there is, and remember it; the answer is out of date when something changes meanwhile."""
        with self.lock:
            scene, config = self.edited_scene(), self.settings.config()
        with self._mitsuba:
            result = live_check(scene, config)
        with self.lock:
            self.check = result
            self.save()
        self._tell("check")
        return result

    def edited_scene(self) -> EditScene:
        """The scene with the regions and the prompt as they are now."""
        return replace(self.scene, regions=self.regions.focal_regions(), prompt=self.prompt)

    # Runs

    def grow(self, seed: int | None = None) -> str:
        """Queue a run of what there is now; its name.

        Raises:
            UserError: what the check refuses.
        """
        if seed is not None:
            self.set_settings(seed=seed)
        refusal = self.check_now().refusal
        if refusal is not None:
            raise UserError(refusal)
        with self.lock:
            folder = self.work.next_run()
            snapshot = self.source.snapshot(folder.name, self._patched(self.source.text))
            place, config = self.work.relative(snapshot, folder), self.settings.config().model_dump(mode="json")
            order = RunOrder(
                place, self.prompt, config, self.source.parameters, self._threads, self._variant
            )  # fmt: skip
            self.shown = folder.name
            name = self.queue.add(folder, order)
            self.save()
            return name

    def another_seed(self) -> str:
        """Queue the same with the next seed that no run has used yet; its name."""
        used = {run.seed for run in self.queue.runs.values()} | {self.settings.seed}
        return self.grow(max(used) + 1)

    def show(self, name: str) -> None:
        """Let the page show a run; "" for none."""
        with self.lock:
            if name and name not in self.queue.runs:
                raise UserError(f"run {name}: is not there")
            self.shown = name
        self._tell("runs")

    def save_scene(self) -> str:
        """Write regions and prompt into the scene that was opened; a line that says what was done.

        Raises:
            UserError: the scene's file was changed so that the regions do not fit any more, or cannot be written.
        """
        source, said = self.source, self.source.described
        before = source.original.read_bytes()
        with self.lock:
            after, prompt = self._patched(before), self.prompt
            regions = list(self.regions.poses.values())
        if after == before:
            return f"{said} has all that already"
        with self._mitsuba:
            write_atomically(source.original, after)
            try:
                scene = load_edit_scene(source.original, source.parameters, None, prompt)
                self._refuse_other_regions(scene, regions)
            except UserError:
                write_atomically(source.original, before)
                raise
            source.renew(scene)
        with self.lock:
            self._before = regions  # as the file has them now
            self.save()
        return f"saved in {said}"

    def _refuse_other_regions(self, scene: EditScene, regions: list[EllipsoidPose]) -> None:
        found = RegionList.of_scene(scene).poses
        if set(found) != {pose.name for pose in regions} or not all(found[p.name].lies_on(p) for p in regions):
            raise UserError(f"{scene.path}: its regions were changed since it was opened here; open it again")

    def edit_again(self, name: str) -> None:
        """Make the result of a run the base of a new round, with the same regions for a start.

        Raises:
            UserError: the run is not finished.
        """
        run = self.queue.runs.get(name)
        if run is None or not (run.folder / "export" / "mitsuba" / "scene.xml").is_file():
            raise UserError(f"run {name or '-'}: has no result yet; let it finish first")
        regions, prompt = list(self.regions.poses.values()), self.prompt
        with self._mitsuba:
            source = self.source.next_round(run.folder, regions, prompt, run.prompt)
            scene = source.load(None)
            glb = base_glb(scene)
        with self.lock:
            self.source, self.scene, self.base_glb, self.prompt = source, scene, glb, scene.prompt
            self._take_scene()
            self.shown, self.check = "", None
            self.save()
        self._tell("scene", check=True)

    def plain(self, text: str) -> str:
        """The text without paths of this machine."""
        return without_paths(text, self.work.path, self.source.original.parent, Path.cwd(), Path.home())

    def save(self) -> None:
        """Write the record of the work folder."""
        with self.lock:
            self.work.write(
                {
                    **self.source.to_json(),
                    "prompt": self.prompt,
                    "regions": [pose.to_json() for pose in self.regions.poses.values()],
                    "meshes": list(self.regions.meshes),
                    "selected": self.selected,
                    "settings": self.settings.to_json(),
                }
            )

    def _patched(self, text: bytes) -> bytes:
        regions = list(self.regions.poses.values())
        return patched(text, self.source.described, regions, self._before, list(self.regions.meshes), self.prompt)

    def _take_scene(self) -> None:
        self.regions = RegionList.of_scene(self.scene)
        self._before = list(self.regions.poses.values())
        self.selected = next(iter(self.regions.poses), "")

    def _restore(self, record: dict[str, Any], settings: StudioSettings) -> None:
        """What the record says, as far as it can be read: a damaged entry leaves the scene's own."""
        try:
            kept = StudioSettings.of_json(record["settings"])
            # What the command line says now counts more than what it said then.
            self.settings = replace(kept, overrides=settings.overrides) if settings.overrides else kept
            self.prompt = str(record["prompt"])
            self.regions.restore(record["regions"], record["meshes"])
            self.selected = next(iter(self.regions.poses), "")
            if record.get("selected") in self.regions.poses:
                self.selected = record["selected"]
        except (KeyError, TypeError, ValueError):
            self._say(f"{self.work.record}: is damaged in part; regions and prompt are taken from the scene")

    def _run_changed(self, name: str) -> None:
        self._tell("runs")

    def _tell(self, topic: str, check: bool = False) -> None:
        if check:
            self._recheck()
        for listener in list(self._listeners):
            listener(topic)


def _prompt_of(opened: Opened, record: dict[str, Any] | None) -> str | None:
    if opened.scene is not None:
        return opened.scene.prompt
    known = (record or {}).get("prompt")
    return known if isinstance(known, str) and known else None
