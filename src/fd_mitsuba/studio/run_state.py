"""What is known of one run of the studio, from the files in its folder alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.runs.run_folder import LIVE_FOLDER
from fd_mitsuba.studio.job import MATERIAL_NAME, MESH_NAME, EventReader
from fd_mitsuba.training.record import read_metrics

QUEUED, STARTING, RUNNING, STOPPING, STOPPED, FINISHED, FAILED = (
    "queued", "starting", "running", "stopping", "stopped", "finished", "failed",
)  # fmt: skip
ACTIVE = (STARTING, RUNNING, STOPPING)
RESUMABLE = (STOPPED, FAILED)


@dataclass
class RunState:
    """One run; `follow` brings it up to date.

    Attributes:
        name: of the folder, such as `001`.
        state: one of the constants of this module.
        stage, phase, step, total: where it is; step 0 before the first.
        losses: of the newest step.
        mesh_step, material_step: step of the newest live mesh, and of the newest material, 0 before the first.
        line: the last thing to show a person: a remark, or why it failed.
        seed, prompt: what makes it this run.
        history: rows (stage, step, loss of the guidance) for a chart.
    """

    folder: Path
    seed: int = 0
    prompt: str = ""
    state: str = STOPPED
    stage: str = ""
    phase: str = ""
    step: int = 0
    total: int = 0
    losses: dict[str, float] = field(default_factory=dict)
    mesh_step: int = 0
    material_step: int = 0
    line: str = ""
    history: list[tuple[str, int, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._events = EventReader(self.folder)

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def live_mesh(self) -> Path:
        """The growing part, user frame."""
        return self.folder / LIVE_FOLDER / MESH_NAME

    @property
    def live_material(self) -> Path:
        """The part with the material learned so far, user frame."""
        return self.folder / LIVE_FOLDER / MATERIAL_NAME

    @property
    def finished_on_disk(self) -> bool:
        """Whether the folder holds a finished run."""
        return "stages" in (read_json_object(self.folder / "metrics.json") or {})

    def follow(self) -> bool:
        """Take in what the run has told since; whether there was anything."""
        rows = list(self._events.new())
        for row in rows:
            self._take(row)
        return bool(rows)

    def settled(self) -> RunState:
        """The state of a run that no process works on: what its files say."""
        if not self.follow():
            self._take_metrics()
        if self.finished_on_disk:
            self.state = FINISHED
        elif self.state != FAILED:
            self.state = STOPPED
        return self

    def _take_metrics(self) -> None:
        """Where a run stands that was not started here: from its own record."""
        rows, config = read_metrics(self.folder / "metrics.jsonl"), read_json_object(self.folder / "config.json") or {}
        if rows:
            steps = (config.get(str(rows[-1].get("stage"))) or {}).get("steps")
            self._take({**rows[-1], "event": "step", "total": steps})

    def _take(self, row: dict[str, Any]) -> None:
        event = row["event"]
        if event == "begun":
            self.state, self.line = STARTING, ""
        elif event == "step":
            if self.state != STOPPING:
                self.state = RUNNING
            self.stage, self.phase = str(row.get("stage")), str(row.get("phase"))
            self.step, self.total = int(row.get("step") or 0), int(row.get("total") or 0)
            losses = row.get("losses")
            self.losses = losses if isinstance(losses, dict) else {}
            if "loss_sds" in self.losses:
                self.history.append((self.stage, self.step, self.losses["loss_sds"]))
        elif event == "mesh":
            self.mesh_step = int(row.get("step") or 0)
        elif event == "material":
            self.material_step = int(row.get("step") or 0)
        elif event == "said":
            self.line = str(row.get("line", ""))
        elif event in ("stopped", "failed"):
            self.state, self.line = (STOPPED if event == "stopped" else FAILED), str(row.get("line", ""))

    def sentence(self) -> str:
        """Where the run is, in words."""
        at = f"{self.stage}, step {self.step} of {self.total}" if self.total else "before its first step"
        if self.state == RUNNING:
            return at if self.step < self.total else f"{self.stage} done, exporting"
        if self.state == STOPPED:
            return f"stopped: {at}"
        return {QUEUED: "waits for its turn", STARTING: "starting", STOPPING: f"stopping: {at}"}.get(
            self.state, self.state
        )
