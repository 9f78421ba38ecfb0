"""Scene and settings in, run folder out: what `fd_mitsuba run` does, as a Python API."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch

from fd_mitsuba import __version__
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.locality import measure_locality
from fd_mitsuba.evaluation.turntable import render_ring, write_sheet, write_video
from fd_mitsuba.export.meshes import copy_base, write_mesh
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.checkpoint import list_checkpoints, load_newest
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import STAGE, run_geometry
from fd_mitsuba.training.run_folder import check_folder, describe_run, write_json

_SHEET_VIEWS = 8


def run(
    scene: EditScene,
    config: RunConfig,
    folder: Path,
    resume: bool = False,
    command: str = "",
    quiet: bool = False,
    say: Callable[[str], None] = print,
) -> dict:
    """Grow the part and write the run folder; returns what `metrics.json` holds.

    Args:
        folder: made if it is missing; must be empty, or hold a run of the same scene and settings to go on with.
        resume: go on with the run in `folder`.
        command: the command line, for the record.
        say: takes remarks for the user, a line each.

    Raises:
        UserError, RunStopped, Interrupted: see `training.loop.run_geometry`.
    """
    started = time.monotonic()
    check_folder(scene, config, folder, resume)
    # Nothing is written before the guidance is there: a wrong model name must not leave a folder that is taken.
    guidance = _guidance(scene, config, say)
    stage = GeometryStage(scene, config, guidance)
    describe_run(scene, config, folder, command)
    run_geometry(stage, folder, resume, quiet, say)
    metrics = export_geometry(stage, folder)
    metrics["seconds"] = round(time.monotonic() - started, 1)
    write_json(folder / "metrics.json", metrics)
    return metrics


def load_finished_stage(scene: EditScene, config: RunConfig, folder: Path) -> GeometryStage:
    """The geometry stage of a run folder at its newest checkpoint, without guidance; UserError if there is none."""
    stage = GeometryStage(scene, config, None)
    if not list_checkpoints(folder / "checkpoints"):
        raise UserError(f"{folder / 'checkpoints'}: no checkpoint; run the geometry stage first")
    done, _ = load_newest(folder / "checkpoints", STAGE, config.content_hash(), stage.field, stage.optimiser)
    if not done:
        raise UserError(f"{folder / 'checkpoints'}: every checkpoint is damaged; run the geometry stage again")
    return stage


def export_geometry(stage: GeometryStage, folder: Path) -> dict:
    """Write meshes, turntable and contact sheet of the stage's present state; returns the measured figures."""
    scene, config, export = stage.scene, stage.config, folder / "export"
    with torch.no_grad():
        union = stage.surface()
    parts = {name: stage.part_solid(name) for name in scene.parts}
    for name, (vertices, faces) in parts.items():
        if len(faces):
            write_mesh(export / f"part_{name}.ply", vertices.numpy(), faces.numpy(), scene)
    write_mesh(export / "assembled.ply", union.vertices.numpy(), union.faces.numpy(), scene)
    identical = copy_base(scene, export / "base")
    whole = stage.part_solid(None)
    base = scene.base_canonical
    locality = measure_locality(
        (whole[0].numpy(), whole[1].numpy()), (base.vertices, base.faces), scene.regions, config.geometry.focal_band
    )
    _write_turntable(stage, whole, folder)
    return {
        "version": __version__,
        "prompt": scene.prompt,
        "seed": config.seed,
        "steps": config.geometry.steps,
        "guidance_model": config.guidance.model,
        **asdict(locality),
        "base_identical": identical,
        "part_faces": {name: len(faces) for name, (_, faces) in parts.items()},
        "assembled_faces": len(union.faces),
    }


def _write_turntable(stage: GeometryStage, part: tuple[torch.Tensor, torch.Tensor], folder: Path) -> None:
    output, aim = stage.config.output, stage.aim
    with torch.no_grad():
        union = stage.surface()
    start = stage.start_surface()
    edited = (union.vertices, union.faces)
    write_video(
        render_ring(edited, output.turntable_frames, output.turntable_size, aim), folder / "videos" / "turntable.mp4"
    )
    size = min(output.turntable_size, 192)
    rows = {
        "base": render_ring((stage.base_surface.vertices, stage.base_surface.faces), _SHEET_VIEWS, size, aim),
        "base with the focal regions": render_ring((start.vertices, start.faces), _SHEET_VIEWS, size, aim),
        f"result: {stage.scene.prompt}": render_ring(edited, _SHEET_VIEWS, size, aim),
        "part": render_ring(part, _SHEET_VIEWS, size, aim),
    }
    write_sheet(rows, folder / "images" / "turntable.png")


def _guidance(scene: EditScene, config: RunConfig, say: Callable[[str], None]) -> DiffusionGuidance | None:
    if config.geometry.lambda_sds == 0:
        return None
    guidance = DiffusionGuidance.load(config.guidance)
    unknown = guidance.set_prompt(scene.prompt, scene.negative_prompt)
    if unknown:
        verb = "is" if len(unknown) == 1 else "are"
        say(
            f"the prompt's {', '.join(map(repr, unknown))} {verb} outside the built-in prior's vocabulary and will not "
            "steer the result; `fd_mitsuba prior` lists the words it knows"
        )
    return guidance
