"""The fields and buttons of the page. What they hold comes from the session; what a person does goes to it.

Setting a field from here calls its handlers too, with no client: those are passed over, so that model and fields cannot
drive each other in circles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.conventions import BASE_LONGEST_SIDE
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.live_check import LiveCheck
from fd_mitsuba.studio.results import FORMATS
from fd_mitsuba.studio.run_state import ACTIVE, FINISHED, QUEUED, RESUMABLE, RUNNING, RunState
from fd_mitsuba.studio.settings import PRESETS

if TYPE_CHECKING:
    import viser

    from fd_mitsuba.studio.session import Session

AXES = {"left - right (x)": 0, "below - above (y)": 1, "back - front (z)": 2}
_REGION_BUTTONS = {"Add on top": "add", "Mirror": "mirror", "Remove": "remove"}
_STEPS = {"Undo": "undo", "Redo": "redo"}
_NO_RUN = "none yet"
_ALONE = "nothing"
_MOST_LOSSES = 4
_EMPTY_CHART = (np.array([0.0, 1.0]), np.array([0.0, 0.0]))


class Panel:
    """Builds the fields; `show_*` fills them from the session.

    Args:
        heard: wraps a handler: it is called with the event only where a client caused it, and errors are shown there.
        actions: name -> what a button does with the event; see `view`.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        heard: Callable[[Callable[[Any], object]], Callable[[Any], None]],
        actions: Mapping[str, Callable[[Any], object]],
        visible: dict[str, bool],
    ) -> None:
        self.session, self._gui, self._heard, self._actions = session, server.gui, heard, actions
        self._gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._gui.set_panel_label("fd_mitsuba studio")
        self._prompt()
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Place"):
            self._region()
        with tabs.add_tab("Grow"):
            self._run()
            self._result()
        with tabs.add_tab("View"):
            for name in visible:
                self._gui.add_checkbox(name, visible[name]).on_update(self._do("visibility"))

    def _button(self, label: str, action: str, **options: Any) -> Any:
        button = self._gui.add_button(label, **options)
        button.on_click(self._do(action))
        return button

    def _do(self, action: str) -> Callable[[Any], None]:
        return self._heard(lambda event: self._actions[action](event))

    def _prompt(self) -> None:
        self.prompt = self._gui.add_text(
            "Prompt", self.session.state.prompt, hint="what the edited object shall look like"
        )
        self.prompt.on_update(self._heard(lambda event: self.session.set_prompt(event.target.value)))
        self.reading = self._gui.add_markdown("")

    def _region(self) -> None:
        session, state = self.session, self.session.state
        names = list(state.regions.poses) or ["-"]
        self.region = self._gui.add_dropdown("Region", names, initial_value=state.selected or names[0])
        self.region.on_update(self._heard(lambda event: session.select(event.target.value)))
        self.part = self._gui.add_text("Part", "part", hint="regions of one part grow together")
        self.centre = self._gui.add_vector3("Centre", (0.0, 0.0, 0.0), step=1e-3)
        longest = BASE_LONGEST_SIDE / state.regions.frame.scale
        self.radii = [
            self._gui.add_slider(
                f"Radius {axis}", _even(longest / 200), _even(longest * 0.6), longest / 1e4, longest / 10
            )
            for axis in "xyz"
        ]
        for field in (self.part, self.centre, *self.radii):
            field.on_update(self._heard(lambda event: self._field_changed()))
        buttons = self._gui.add_button_group("Region", tuple(_REGION_BUTTONS))
        buttons.on_click(self._heard(lambda event: self._actions[_REGION_BUTTONS[event.target.value]](event)))
        self.axis = self._gui.add_dropdown("Mirror along", list(AXES))
        self._button("Add by a click on the base", "pick", icon="click")
        steps = self._gui.add_button_group("Change", tuple(_STEPS))
        steps.on_click(self._heard(lambda event: self._actions[_STEPS[event.target.value]](event)))
        self.check = self._gui.add_markdown("checking...")

    def _field_changed(self) -> None:
        with self.session.lock:
            state = self.session.state
            pose = state.regions.pose(state.selected)
            centre = tuple(
                old if abs(old - new) < 5e-4 else new for old, new in zip(pose.centre, self.centre.value, strict=True)
            )  # the field shows three digits: what it did not change keeps all of its own
            radii = tuple(float(slider.value) for slider in self.radii)
            same = all(
                abs(old - new) <= slider.step for old, new, slider in zip(pose.radii, radii, self.radii, strict=True)
            )
            radii = pose.radii if same else radii
            self.session.put(replace(pose, part=self.part.value.strip() or pose.part, centre=centre, radii=radii))

    def _run(self) -> None:
        settings = self.session.state.settings
        presets = list(dict.fromkeys([settings.preset, *PRESETS]))
        self.preset = self._gui.add_dropdown("Settings", presets, initial_value=settings.preset)
        self.seed = self._gui.add_number("Seed", settings.seed, min=0, max=2**31 - 1, step=1)
        self.steps = self._gui.add_number(
            "Steps", settings.steps, min=0, max=100_000, step=1, hint="0: as the settings"
        )
        for name in ("preset", "seed", "steps"):
            field = getattr(self, name)
            field.on_update(
                self._heard(lambda event, name=name: self.session.set_settings(**{name: _whole(event.target.value)}))
            )
        self.estimate = self._gui.add_markdown("")
        self.grow = self._button("Grow", "grow", color="green", icon="plant")
        self._button("Grow with another seed", "another_seed")
        self._button("Save scene", "save", icon="device-floppy")

    def _result(self) -> None:
        self.shown = self._gui.add_dropdown("Run", [_NO_RUN])
        self.shown.on_update(self._do("show"))
        self.beside = self._gui.add_dropdown("Beside it", [_ALONE], hint="another result, to compare")
        self.beside.on_update(self._do("compare"))
        self.status = self._gui.add_markdown("")
        self.bar = self._gui.add_progress_bar(0.0)
        self.chart = self._gui.add_uplot(
            _EMPTY_CHART,
            ({}, {"label": "loss of the guidance", "stroke": "#c08000", "width": 1}),
            scales={"x": {"time": False}},
            legend={"show": False},
            height=110,
            visible=False,
        )
        self.stop = self._button("Stop", "stop", icon="player-stop")
        self.resume = self._button("Resume", "resume", icon="player-play")
        self.format = self._gui.add_dropdown("Download as", list(FORMATS))
        self.download = self._button("Download", "download", icon="download")
        self.again = self._button("Edit again", "edit_again", hint="the result becomes the base of another round")

    def show_regions(self) -> None:
        """Names and the selected region's numbers."""
        state = self.session.state
        names = list(state.regions.poses) or ["-"]
        if tuple(names) != tuple(self.region.options):
            self.region.options = names
        self.region.value = state.selected or names[0]
        if state.selected:
            self.show_pose(state.regions.poses[state.selected])

    def show_pose(self, pose: EllipsoidPose) -> None:
        """The numbers of the selected region."""
        self.part.value = pose.part
        self.centre.value = np.round(pose.centre, 3)
        for slider, radius in zip(self.radii, pose.radii, strict=True):
            if radius > slider.max:
                slider.max = _even(radius * 1.2)
            slider.value = max(radius, slider.min)

    def show_prompt(self) -> None:
        """The prompt as the session has it; blanks that a person is typing stay."""
        if " ".join(self.prompt.value.split()) != self.session.state.prompt:
            self.prompt.value = self.session.state.prompt

    def show_settings(self) -> None:
        """Preset, seed, steps."""
        settings = self.session.state.settings
        self.preset.value, self.seed.value, self.steps.value = settings.preset, settings.seed, settings.steps

    def show_check(self, check: LiveCheck) -> None:
        """What is understood and refused, where the regions lie, how long it takes."""
        plain = self.session.plain
        told = f"\n\ntold to the prior: *{_escaped(check.told)}*" if check.told else ""
        words = f"read as {_escaped(check.understood)}{told}" if check.understood else "taken as it is"
        self.reading.content = words if check.refusal is None else f"**Refused:** {_escaped(plain(check.refusal))}"
        lines = [f"- {_escaped(plain(line))}" for line in check.regions]
        lines += [f"- **Warning:** {_escaped(plain(line))}" for line in check.warnings]
        self.check.content = "\n".join(lines) or "-"
        self.estimate.content = check.estimate if check.refusal is None else "**not possible yet**, see above"
        self.grow.disabled = check.refusal is not None

    def show_runs(self) -> None:
        """The runs, and the state of the one that is shown."""
        session = self.session
        labels = run_labels(list(session.queue.runs.values()))
        names = list(labels.values()) or [_NO_RUN]
        if tuple(names) != tuple(self.shown.options):
            self.shown.options = names
        finished = [_ALONE, *(labels[run.name] for run in session.queue.runs.values() if run.state == FINISHED)]
        if tuple(finished) != tuple(self.beside.options):
            self.beside.options = finished
        self.beside.value = labels.get(session.beside, _ALONE)
        run = session.queue.runs.get(session.shown)
        self.shown.value = names[-1] if run is None else labels[run.name]
        state = "" if run is None else run.state
        self.status.content = "" if run is None else self._status(run)
        done = 0.0 if run is None or not run.total else 100.0 * run.step / run.total
        self.bar.value = 100.0 if state == FINISHED else done
        self.bar.animated = state in ACTIVE
        rows = [] if run is None else [row[1:] for row in run.history if row[0] == run.stage]
        self.chart.visible = len(rows) > 1 and state != FINISHED
        if self.chart.visible:
            self.chart.data = tuple(np.array(column, dtype=np.float64) for column in zip(*rows, strict=True))
        self.stop.visible = state in (*ACTIVE, QUEUED)
        self.resume.visible = state in RESUMABLE
        for handle in (self.format, self.download, self.again):
            handle.visible = state == FINISHED

    def _status(self, run: RunState) -> str:
        waiting = self.session.queue.waiting
        place = waiting.index(run.name) + 1 if run.name in waiting else 0
        lines = [f"**{run.sentence()}**" + (f" (place {place})" if place else "")]
        if run.state == RUNNING and run.losses:
            shown = list(run.losses.items())[:_MOST_LOSSES]
            lines.append(", ".join(f"{key.removeprefix('loss_')} {value:.3g}" for key, value in shown))
        if run.line:
            lines.append(_escaped(self.session.plain(run.line)))
        return "\n\n".join(lines)

    def run_of(self, label: str) -> str:
        """The name of the run with a label of the dropdown; "" for none."""
        labels = run_labels(list(self.session.queue.runs.values()))
        return next((name for name, text in labels.items() if text == label), "")


def run_labels(runs: list[RunState]) -> dict[str, str]:
    """Name of a run -> what the dropdown calls it. A label stays the same as the run goes on."""
    return {run.name: f"{run.name}: {run.prompt[:40]} (seed {run.seed})" for run in runs}


def _even(value: float) -> float:
    """Two digits of a number, for the ends of a slider."""
    return float(f"{value:.2g}")


def _whole(value: Any) -> Any:
    return value if isinstance(value, str) else int(value)


def _escaped(text: str) -> str:
    """Text as Markdown that shows it and nothing else."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]()<>#+!|" else letter for letter in text)
