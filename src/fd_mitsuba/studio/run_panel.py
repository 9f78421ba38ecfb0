"""The fields and buttons for runs: their settings, how they go, what becomes of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.studio.action_panel import ActionPanel
from fd_mitsuba.studio.live_check import LiveCheck
from fd_mitsuba.studio.plain_text import escaped
from fd_mitsuba.studio.results import FORMATS
from fd_mitsuba.studio.run_state import ACTIVE, FINISHED, QUEUED, RESUMABLE, RUNNING, RunState
from fd_mitsuba.studio.settings import PRESETS

if TYPE_CHECKING:
    import viser

    from fd_mitsuba.studio.session import Session

_NO_RUN = "none yet"
_ALONE = "nothing"
_MOST_LOSSES = 4
_EMPTY_CHART = (np.array([0.0, 1.0]), np.array([0.0, 0.0]))


class RunPanel(ActionPanel):
    """Builds its fields where the caller's tab is open; arguments as of `Panel`."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        heard: Callable[[Callable[[Any], object]], Callable[[Any], None]],
        actions: Mapping[str, Callable[[Any], object]],
    ) -> None:
        super().__init__(server.gui, heard, actions)
        self.session = session
        self._run()
        self._result()

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
                self._heard(
                    lambda event, name=name: self.session.edits.set_settings(**{name: _whole(event.target.value)})
                )
            )
        self.estimate = self._gui.add_markdown("")
        self.grow = self._button("Grow", "grow", color="green", icon="plant")
        self.another = self._button("Grow with another seed", "another_seed")
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
            axes=({"size": 30}, {"size": 64}),
            height=110,
            visible=False,
        )
        self.stop = self._button("Stop", "stop", icon="player-stop")
        self.resume = self._button("Resume", "resume", icon="player-play")
        self.format = self._gui.add_dropdown("Download as", list(FORMATS))
        self.download = self._button("Download", "download", icon="download")
        self.again = self._button("Edit again", "edit_again", hint="the result becomes the base of another round")

    def show_settings(self) -> None:
        """Preset, seed, steps."""
        settings = self.session.state.settings
        self.preset.value, self.seed.value, self.steps.value = settings.preset, settings.seed, settings.steps

    def show_check(self, check: LiveCheck) -> None:
        """How long a run would take, and whether one can be started."""
        self.estimate.content = check.estimate if check.refusal is None else "**not possible yet**, see above"
        self.let_grow(check.refusal is None)

    def let_grow(self, possible: bool) -> None:
        """Whether a run can be started now."""
        self.grow.disabled = self.another.disabled = not possible

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
            lines.append(escaped(self.session.plain(run.line)))
        return "\n\n".join(lines)

    def run_of(self, label: str) -> str:
        """The name of the run with a label of the dropdown; "" for none."""
        labels = run_labels(list(self.session.queue.runs.values()))
        return next((name for name, text in labels.items() if text == label), "")


def run_labels(runs: list[RunState]) -> dict[str, str]:
    """Name of a run -> what the dropdown calls it. A label stays the same as the run goes on."""
    return {run.name: f"{run.name}: {run.prompt[:40]} (seed {run.seed})" for run in runs}


def _whole(value: Any) -> Any:
    return value if isinstance(value, str) else int(value)
