"""What `check` finds out about a run, as values and as lines for a person."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from fd_mitsuba.errors import printable
from fd_mitsuba.guidance.prompt_reader import PromptReading
from fd_mitsuba.runs.cost import CostEstimate
from fd_mitsuba.scene.triangle_mesh import Topology


@dataclass(frozen=True)
class BaseCheck:
    """One mesh of the base: sizes, and `Topology` with positions taken as one where they are equal."""

    name: str
    vertices: int
    faces: int
    volume: float
    """Enclosed volume in the user's units; negative where the faces point inwards, rough where the mesh is open."""
    topology: Topology


@dataclass(frozen=True)
class RegionCheck:
    """One focal region, lengths in the user's units."""

    name: str
    part: str
    share_in_grid: float
    gap_to_base: float
    share_in_base: float
    """Share of the region's volume that the base already fills."""
    volume_cells: float
    thickness_cells: float


@dataclass(frozen=True)
class CheckReport:
    """Everything `fd_mitsuba check` prints. A scene that cannot be edited at all never gets here: loading it fails."""

    scene: str
    prompt: str
    base: tuple[BaseCheck, ...]
    base_closed: bool
    base_low: tuple[float, ...]
    base_high: tuple[float, ...]
    """Corners of the base's bounding box in the user's units."""
    longest_side: float
    """Longest side of the base's bounding box in the user's units."""
    grid_cell: float
    """Side of a grid cell in the user's units."""
    grid_low: tuple[float, ...]
    grid_high: tuple[float, ...]
    """Corners of the cube in the user's units within which a part can grow."""
    has_headroom: bool
    """Whether that cube was moved or enlarged to hold the regions; see `scene.headroom`."""
    regions: tuple[RegionCheck, ...]
    cost: CostEstimate
    warnings: tuple[str, ...]
    prompt_reading: PromptReading | None = None
    """What the guidance model understands of the prompt; None where it takes any text, or where no model is asked."""
    part_readings: dict[str, PromptReading] = dataclasses.field(default_factory=dict)
    """The same of the prompts that parts have of their own."""
    surroundings: tuple[str, ...] = ()
    """Shapes of the scene that are not edited, as exports call them."""
    base_choice: str = ""
    model_choice: str = ""
    """How it was found out which shapes are edited, where the scene does not say."""
    refusal: str | None = None
    """Why a run with these settings would end before its first step; None: it would not."""

    def to_json(self) -> dict[str, Any]:
        """The report as plain dicts, lists, numbers and strings for `json.dumps`, keys as the attributes."""
        return dataclasses.asdict(self)

    def lines(self) -> list[str]:
        """The report as lines for a person, warnings last."""
        lines = [f"scene    {self.scene}", f"prompt   {self.prompt}"]
        if self.model_choice:
            lines.append(f"model    {self.model_choice.removeprefix('guidance.model: ')}")
        if self.prompt_reading is not None:
            lines.append(f"read as  {self.prompt_reading.summary()}")
            lines.append(f"         the prior is told {self.prompt_reading.caption!r}")
        for part, reading in self.part_readings.items():
            lines.append(f"prompt   of part {part}, read as {reading.summary()}")
            lines.append(f"         the prior is told {reading.caption!r}")
        for mesh in self.base:
            found = mesh.topology
            state = _closedness(found)
            pieces = f"{found.components} component{'s' if found.components != 1 else ''}"
            lines.append(f"base     {mesh.name}: {mesh.vertices} vertices, {mesh.faces} faces, {state}, {pieces}")
        if self.surroundings:
            lines.append(f"around   {', '.join(self.surroundings)}: lit, cast shadows and reflect, are not edited")
        if self.base_choice:
            lines.append("         chosen by where the regions are; dual_path's `base` names the shapes to edit")
        lines.append(f"frame    longest side {self.longest_side:.4g}, grid cell {self.grid_cell:.3g} (scene units)")
        lines.append(f"         base {_box(self.base_low, self.base_high)}")
        roomy = ", enlarged to hold the regions" if self.has_headroom else ""
        lines.append(f"         grid {_box(self.grid_low, self.grid_high)}{roomy}")
        for region in self.regions:
            touch = "touches the base" if region.gap_to_base == 0 else f"{region.gap_to_base:.3g} from the base"
            lines.append(
                f"region   {region.name} (part {region.part}): {touch}, {region.share_in_grid:.1%} in the grid, "
                f"{region.share_in_base:.0%} within the base, {region.thickness_cells:.1f} cells thin"
            )
        cost = self.cost
        lines.append(
            f"cost     shape: about {_number(cost.seconds_per_step)} s a step, {_duration(cost.seconds_total)} in all, "
            f"{cost.geometry_memory_mb * 2**20 / 1e9:.1f} GB of memory; {cost.active_share:.1%} of the grid active"
        )
        if cost.appearance_seconds_total > 0:
            step, whole = _number(cost.appearance_seconds_per_step), _duration(cost.appearance_seconds_total)
            peak = cost.memory_mb * 2**20 / 1e9
            lines.append(f"         material: about {step} s a step, {whole} in all, {peak:.1f} GB of memory")
        lines += [f"         assumes {assumption}" for assumption in cost.assumptions]
        fine = [] if self.refusal is not None else ["ok       nothing to warn of"]
        lines += [f"warning  {warning}" for warning in self.warnings] or fine
        return [printable(line) for line in lines]


def _closedness(found: Topology) -> str:
    if found.boundary_edges:
        return f"open ({found.boundary_edges} boundary edges)"
    if found.closed:
        return "closed"
    if found.misoriented_edges:
        return f"without holes, but {found.misoriented_edges} edges have faces that point opposite ways"
    return f"without holes, but {found.nonmanifold_edges} edges have an odd number of faces"


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> str:
    return ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
