"""What the page says of the regions and the prompt as they are: `check` in short, with the settings of the run."""

from __future__ import annotations

from dataclasses import dataclass

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.runs.check_report import CheckReport
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.headroom import FITS
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.region_place import gap_to_base, misplacement


@dataclass(frozen=True)
class LiveCheck:
    """Attributes:
    refusal: why a run would not start; None: it would.
    understood: how the guidance model reads the prompt; "" where it takes any text.
    told: what the model is told instead.
    regions: a line each: touching, in the grid, headroom.
    warnings: as of `check`.
    seconds: of the geometry stage and the appearance stage, roughly.
    grid: corners of the cube in which a part can grow, user frame; it makes room for regions that stand out.
    """

    refusal: str | None = None
    understood: str = ""
    told: str = ""
    regions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    seconds: tuple[float, float] = (0.0, 0.0)
    grid: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    @property
    def estimate(self) -> str:
        """The time in words."""
        shape, material = (_minutes(value) for value in self.seconds)
        return f"about {shape} for the shape, {material} for the material"


def live_check(scene: EditScene, config: RunConfig) -> LiveCheck:
    """The check of a scene whose regions or prompt a person has changed. Takes about a second; raises nothing."""
    if not scene.prompt:
        return LiveCheck("the prompt is blank; describe the edited object")
    if not scene.regions:
        return LiveCheck("there is no region yet; add one by a click on the base")
    refusal = _misplaced(scene)
    try:
        report = check_scene(scene, config)
    except UserError as error:
        return LiveCheck(refusal or str(error))
    reading, parts = report.prompt_reading, report.part_readings
    return LiveCheck(
        refusal or _prompt_refusal(scene, report),
        "; ".join(
            [] if reading is None else [reading.summary(), *(f"{name}: {p.summary()}" for name, p in parts.items())]
        ),
        "" if reading is None else reading.caption,
        tuple(_regions(scene, report)),
        report.warnings,
        (report.cost.seconds_total, report.cost.appearance_seconds_total),
        (report.grid_low, report.grid_high),
    )


def _prompt_refusal(scene: EditScene, report: CheckReport) -> str | None:
    """Why a run would not take the prompt; in words of its own for the one that an imported mesh starts with."""
    if report.refusal is not None and scene.prompt == scene.base_prompt:
        return f"the prompt says only what is there; write what to add, as in '{scene.prompt} with a hat'"
    return report.refusal


def _misplaced(scene: EditScene) -> str | None:
    """What loading the scene would refuse."""
    soup = scene.base_canonical
    distance = MeshDistance(soup.vertices, soup.faces)
    for region in scene.regions:
        if problem := misplacement(region, gap_to_base(region, distance, soup), scene.frame):
            return f"region {region.name}: {problem}"
    return None


def _regions(scene: EditScene, report: CheckReport) -> list[str]:
    lines = []
    for region, found in zip(scene.regions, report.regions, strict=True):
        touch = "touches the base" if found.gap_to_base == 0 else f"{found.gap_to_base:.3g} away from the base"
        top = float(scene.frame.to_user(region.bounds[1])[1])
        room = report.grid_high[1] - top
        too_high = f"{-room:.3g} too high for the grid" if found.share_in_grid < FITS else "no room above"
        above = f"{room:.3g} of room above" if room >= 0 else too_high
        inside = f"{found.share_in_base:.0%} inside the base"
        lines.append(f"{found.name}: {touch}, {found.share_in_grid:.0%} in the grid, {inside}, {above}")
    return lines


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
