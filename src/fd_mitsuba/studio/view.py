"""The page: brings panel, canvas and session together. All tabs see the same; there is no state of one tab alone."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.canvas import Canvas
from fd_mitsuba.studio.panel import AXES, Panel
from fd_mitsuba.studio.results import download, shown_key, shown_part, whole_result

if TYPE_CHECKING:
    import viser

    from fd_mitsuba.studio.session import Session

_NOTE_SECONDS = 8.0
_BETWEEN = 0.4
"""Room between two results that are compared, canonical units."""


class View:
    """Shows a session through a viser server, until either ends."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self.server, self.session = server, session
        self._lock = session.lock  # one for both: whoever tells and whoever shows cannot wait for each other
        self._part_key = self._beside_key = ""
        self._whole = False
        self.canvas = Canvas(server, self._clicked_region, self._gizmo_moved, self._clicked_base)
        actions: dict[str, Callable[[Any], object]] = {
            "mirror": lambda event: session.edits.mirror(session.state.selected, AXES[self.panel.axis.value]),
            "pick": self._pick,
            "add": lambda event: session.edits.add(),
            "undo": lambda event: session.edits.undo(),
            "redo": lambda event: session.edits.redo(),
            "remove": lambda event: session.edits.remove(session.state.selected),
            "grow": lambda event: self._grow(session.grow),
            "another_seed": lambda event: self._grow(session.another_seed),
            "save": lambda event: self._note(event, session.save_scene()),
            "show": lambda event: session.show(self.panel.runs.run_of(event.target.value)),
            "compare": lambda event: session.compare(self.panel.runs.run_of(event.target.value)),
            "stop": lambda event: session.queue.stop(session.shown),
            "resume": lambda event: session.queue.resume(session.shown),
            "download": self._download,
            "edit_again": lambda event: session.edit_again(session.shown),
            "visibility": self._visibility,
            "shading": lambda event: self._looks(self.canvas.objects.set_shading, event),
            "material": lambda event: self._looks(self.canvas.objects.set_material, event),
            "light": lambda event: self._looks(self._light, event),
        }
        self.panel = Panel(server, session, self._heard, actions, self.canvas.visible)
        session.subscribe(self._told)
        for topic in ("scene", "settings", "prompt"):
            self._told(topic)

    def close(self) -> None:
        """Show nothing any more: the server is about to end."""
        self.session.unsubscribe(self._told)

    def _told(self, topic: str) -> None:
        """Something has changed: show it. Called from any thread."""
        with self._lock:
            try:
                self._refresh(topic)
            except UserError as error:
                print(f"fd_mitsuba: {error}")
            except Exception:  # whoever tells, such as the queue, goes on
                traceback.print_exc()

    def _refresh(self, topic: str) -> None:
        session, panel, canvas = self.session, self.panel, self.canvas
        state = session.state
        pose, frame = state.regions.poses.get(state.selected), state.regions.frame
        poses, meshes = list(state.regions.poses.values()), list(state.regions.meshes.values())
        if topic == "scene":
            canvas.objects.show_no_part()
            self._part_key = ""
            self._show_beside()
            self._light(panel.light.value)
            canvas.objects.show_base(state.glb, frame, state.base)
        if topic in ("scene", "regions"):
            canvas.show_regions(poses, meshes, frame)
        if topic in ("scene", "regions", "selected"):
            panel.show_regions()
            canvas.show_gizmo(pose, frame)
        if topic == "pose" and pose is not None:
            canvas.place_region(pose, frame)
            canvas.show_gizmo(pose, frame)
            panel.show_pose(pose)
        if topic in ("scene", "prompt"):
            panel.show_prompt()
        if topic == "settings":
            panel.runs.show_settings()
        if topic == "check" and session.checks.newest is not None:
            panel.show_check(session.checks.newest)
            if session.checks.newest.grid is not None:
                canvas.show_grid(*(frame.to_canonical(np.array(corner)) for corner in session.checks.newest.grid))
        if topic in ("scene", "runs"):
            panel.runs.show_runs()
            self._show_part()
            self._show_beside()

    def _show_beside(self) -> None:
        run = self.session.queue.runs.get(self.session.beside)
        key = "" if run is None else run.name
        if key == self._beside_key:
            return
        self._beside_key = key
        state = self.session.state
        width = float(np.ptp(state.base.vertices[:, 0])) + _BETWEEN
        self.canvas.objects.show_beside(None if run is None else whole_result(run), state.regions.frame, width)

    def _show_part(self) -> None:
        run = self.session.queue.runs.get(self.session.shown)
        key = "" if run is None else shown_key(run)
        if key == self._part_key:
            return
        frame = self.session.state.regions.frame
        part = None if run is None else shown_part(run, frame)
        self._part_key, self._whole = key, part is not None and part.whole
        objects = self.canvas.objects
        objects.base_hidden = self._whole
        if part is None or not len(part.faces):
            objects.show_no_part()
        else:
            objects.show_part(part.vertices, part.faces, frame, part.glb)
        self.canvas.apply_visibility()

    def _heard(self, handler: Callable[[Any], object]) -> Callable[[Any], None]:
        """The handler for what a person does: not called where the program itself set a field."""

        def call(event: Any) -> None:
            if getattr(event, "client", None) is None:
                return
            try:
                handler(event)
            except UserError as error:
                self._note(event, self.session.plain(str(error)), "red")
                self._again()
            except Exception:
                traceback.print_exc()
                self._note(event, "that went wrong; the terminal has more about it", "red")

        return call

    def _grow(self, begin: Callable[[], str]) -> None:
        self.panel.runs.let_grow(False)  # the check takes a moment, in which nobody shall ask twice
        try:
            begin()
        finally:
            check = self.session.checks.newest
            self.panel.runs.let_grow(check is None or check.refusal is None)

    def _again(self) -> None:
        """Fields that hold what was refused go back to what is."""
        for topic in ("selected", "prompt", "settings", "runs"):
            self._told(topic)

    def _note(self, event: Any, text: str, color: Any = None) -> None:
        event.client.add_notification("fd_mitsuba", text, auto_close_seconds=_NOTE_SECONDS, color=color)

    def _pick(self, event: Any) -> None:
        self.canvas.picking(True)
        self._note(event, "click on the base to put the region there")

    def _clicked_region(self, name: str) -> None:
        self.session.edits.select(name)

    def _clicked_base(self, event: Any) -> None:
        self.canvas.picking(False)
        self.session.edits.add_at(event.ray_origin, event.ray_direction)

    def _gizmo_moved(self, position: np.ndarray, wxyz: np.ndarray) -> None:
        session = self.session
        with session.lock:
            state = session.state
            pose = state.regions.poses.get(state.selected)
            if pose is not None:
                session.edits.put(pose.moved(state.regions.frame.to_user(position), wxyz))

    def _visibility(self, event: Any) -> None:
        with self._lock:
            self.canvas.visible[event.target.label] = bool(event.target.value)
            self.canvas.apply_visibility()

    def _light(self, name: str) -> None:
        self.canvas.set_light(name, self.session.state.light)

    def _looks(self, change: Callable[[str], None], event: Any) -> None:
        with self._lock:
            change(event.target.value)

    def _download(self, event: Any) -> None:
        run = self.session.queue.runs.get(self.session.shown)
        if run is None:
            raise UserError("there is no run yet; grow a part first")
        wanted = self.panel.runs.format.value
        name, data = download(run, wanted)
        event.client.send_file_download(name, data, save_immediately=True)
