"""What the processes beside the first do of a run: the same steps with views of their own, and nothing is written."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.runs.appearance_outcome import cuts_stay_plain, opened_base, parts_of_run, prepare_appearance
from fd_mitsuba.runs.choices import checked_choices
from fd_mitsuba.runs.geometry_outcome import prepare_geometry
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.appearance_stage import AppearanceStage
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import run_stage


def follow(
    scene: EditScene,
    config: RunConfig,
    folder: Path,
    resume: bool,
    stages: Collection[str],
    geometry_from: Path | None,
) -> None:
    """Take part in the run that process 0 does by `pipeline.run`."""
    config = checked_choices(config)
    if cuts_stay_plain(scene, config):
        stages = tuple(stage for stage in stages if stage != "appearance")
    with_geometry = "geometry" in stages and geometry_from is None
    for_geometry = prepare_geometry(scene, config, _silent) if with_geometry else None
    for_appearance = None
    if "appearance" in stages:
        for_appearance = prepare_appearance(scene, config, _silent, _silent, for_geometry)
    if with_geometry:
        run_stage(GeometryStage(scene, config, for_geometry), folder, resume, True, _silent)
    processes().wait()  # for the parts that process 0 writes
    if "appearance" in stages:
        parts = parts_of_run(scene, folder)
        stage = AppearanceStage(scene, config, parts, for_appearance, _silent, opened_base(scene, folder))
        run_stage(stage, folder, resume, True, _silent)


def refuse_guidance_alone(guidance: object) -> None:
    """UserError where several processes would share the views of a guidance that knows of no others."""
    if processes().count > 1 and not isinstance(guidance, DiffusionGuidance | None):
        raise UserError(
            f"torchrun: {type(guidance).__name__} guides all views of a step at once; run it in one process, or take a "
            "diffusion model"
        )


def _silent(line: str) -> None:
    pass
