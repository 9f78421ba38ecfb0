"""The fields and buttons of the page. What they hold comes from the session; what a person does goes to it.

Setting a field from here calls its handlers too, with no client: those are passed over, so that model and fields cannot
drive each other in circles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.conventions import BASE_LONGEST_SIDE
from fd_mitsuba.studio.action_panel import ActionPanel
from fd_mitsuba.studio.canvas import LIGHTS
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.live_check import LiveCheck
from fd_mitsuba.studio.plain_text import escaped
from fd_mitsuba.studio.run_panel import RunPanel
from fd_mitsuba.studio.shading import MATERIALS, SHADINGS
from fd_mitsuba.studio.uploads import PATH

if TYPE_CHECKING:
    import viser

    from fd_mitsuba.studio.session import Session

AXES = {"left - right (x)": 0, "below - above (y)": 1, "back - front (z)": 2}
_REGION_BUTTONS = {"Add on top": "add", "Mirror": "mirror", "Remove": "remove"}
_STEPS = {"Undo": "undo", "Redo": "redo"}
_FRAME_STYLE = "width: 95%; height: 38px; margin: 0 2.5%; border: 0"
_UPLOAD = f'<iframe src="{PATH[1:]}" title="Open a mesh" style="{_FRAME_STYLE}"></iframe>'


class Panel(ActionPanel):
    """Builds the fields; `show_*` fills them from the session.

    Args:
        heard: wraps a handler: it is called with the event only where a client caused it, and errors are shown there.
        actions: name -> what a button does with the event; see `view`.

    Attributes:
        runs: the tab for runs and their results.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        heard: Callable[[Callable[[Any], object]], Callable[[Any], None]],
        actions: Mapping[str, Callable[[Any], object]],
        visible: dict[str, bool],
    ) -> None:
        super().__init__(server.gui, heard, actions)
        self.session = session
        self._gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._gui.set_panel_label("fd_mitsuba studio")
        # Outside the tabs: what is in one is gone while another is shown, and its upload would be, too.
        self._gui.add_html(_UPLOAD)
        self._prompt()
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Place"):
            self._region()
        with tabs.add_tab("Grow"):
            self.runs = RunPanel(server, session, heard, actions)
        with tabs.add_tab("View"):
            for name in visible:
                self._gui.add_checkbox(name, visible[name]).on_update(self._do("visibility"))
            self.shading = self._gui.add_dropdown("Shown as", SHADINGS)
            self.shading.on_update(self._do("shading"))
            tried = "tried on the part here; its own is in what is downloaded"
            self.material = self._gui.add_dropdown("Part's material", tuple(MATERIALS), hint=tried)
            self.material.on_update(self._do("material"))
            self.light = self._gui.add_dropdown("Light", tuple(LIGHTS), hint="of this page; a run is lit by the scene")
            self.light.on_update(self._do("light"))

    def _prompt(self) -> None:
        self.prompt = self._gui.add_text(
            "Prompt", self.session.state.prompt, hint="what the edited object should look like"
        )
        self.prompt.on_update(self._heard(lambda event: self.session.edits.set_prompt(event.target.value)))
        self.reading = self._gui.add_markdown("")

    def _region(self) -> None:
        session, state, actions = self.session, self.session.state, self._actions
        names = list(state.regions.poses) or ["-"]
        self.region = self._gui.add_dropdown("Region", names, initial_value=state.selected or names[0])
        self.region.on_update(self._heard(lambda event: session.edits.select(event.target.value)))
        self.part = self._gui.add_text("Part", "part", hint="regions of one part grow together")
        self.part_prompt = self._gui.add_text(
            "Its prompt", "", hint="what this part alone should be, as in 'a hat'; blank: the prompt above says it"
        )
        self.centre = self._gui.add_vector3("Centre", (0.0, 0.0, 0.0), step=1e-3)
        low, high, step = _range_of_radii(state.regions.frame.scale)
        self.radii = [self._gui.add_slider(f"Radius {axis}", low, high, step, high / 6) for axis in "xyz"]
        for field in (self.part, self.part_prompt, self.centre, *self.radii):
            field.on_update(self._heard(lambda event: self._field_changed()))
        self.place_buttons = self._gui.add_button_group("Region", tuple(_REGION_BUTTONS))
        self.place_buttons.on_click(
            self._heard(lambda event: self._actions[_REGION_BUTTONS[event.target.value]](event))
        )
        self.axis = self._gui.add_dropdown("Mirror along", list(AXES))
        self._button("Add by a click on the base", "pick", icon="click")
        self.change_buttons = self._gui.add_button_group("Change", tuple(_STEPS))
        self.change_buttons.on_click(self._heard(lambda event: actions[_STEPS[event.target.value]](event)))
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
            words = " ".join(self.part_prompt.value.split())
            named = replace(pose, part=self.part.value.strip() or pose.part, prompt=words)
            self.session.edits.put(replace(named, centre=centre, radii=radii))

    def show_regions(self) -> None:
        """Names and the selected region's numbers; another base has another range of radii."""
        state = self.session.state
        low, high, step = _range_of_radii(state.regions.frame.scale)
        for slider in self.radii:
            if (slider.min, slider.step) != (low, step):
                slider.min, slider.max, slider.step = low, high, step
        names = list(state.regions.poses) or ["-"]
        if tuple(names) != tuple(self.region.options):
            self.region.options = names
        self.region.value = state.selected or names[0]
        if state.selected:
            self.show_pose(state.regions.poses[state.selected])

    def show_pose(self, pose: EllipsoidPose) -> None:
        """The numbers of the selected region."""
        self.part.value = pose.part
        if " ".join(self.part_prompt.value.split()) != pose.prompt:  # blanks that are being typed stay
            self.part_prompt.value = pose.prompt
        self.centre.value = np.round(pose.centre, 3)
        for slider, radius in zip(self.radii, pose.radii, strict=True):
            if radius > slider.max:
                slider.max = _even(radius * 1.2)
            slider.value = max(round(radius, _digits(slider.step)), slider.min)

    def show_prompt(self) -> None:
        """The prompt as the session has it; blanks that a person is typing stay."""
        if " ".join(self.prompt.value.split()) != self.session.state.prompt:
            self.prompt.value = self.session.state.prompt

    def show_check(self, check: LiveCheck) -> None:
        """What is understood and refused, where the regions lie, how long it takes."""
        plain = self.session.plain
        told = f"\n\ntold to the prior: *{escaped(check.told)}*" if check.told else ""
        words = f"read as {escaped(check.understood)}{told}" if check.understood else "taken as it is"
        self.reading.content = words if check.refusal is None else f"**Refused:** {escaped(plain(check.refusal))}"
        lines = [f"- {escaped(plain(line))}" for line in check.regions]
        lines += [f"- **Warning:** {escaped(plain(line))}" for line in check.warnings]
        self.check.content = "\n".join(lines) or "-"
        self.runs.show_check(check)


def _range_of_radii(scale: float) -> tuple[float, float, float]:
    """Least, most and step of a radius in user units, for a base that is so much smaller in the canonical frame."""
    longest = BASE_LONGEST_SIDE / scale
    return _even(longest / 200), _even(longest * 0.6), longest / 1e4


def _digits(step: float) -> int:
    """Behind the decimal point, as many as it takes to tell one step from the next: more do not fit into the field."""
    return max(0, -math.floor(math.log10(step)))


def _even(value: float) -> float:
    """Two digits of a number, for the ends of a slider."""
    return float(f"{value:.2g}")
