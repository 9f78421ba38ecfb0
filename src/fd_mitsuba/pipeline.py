"""Scene and settings in, run folder out: what `fd_mitsuba run` does, as a Python API."""

from __future__ import annotations

import json
import platform
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib import metadata
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
from fd_mitsuba.training.checkpoint import list_checkpoints, load_newest, write_atomically
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import STAGE, run_geometry

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
        folder: made if it is missing; must be empty or hold an interrupted run of the same scene and settings (`resume`).
        command: the command line, for the record.
        say: takes remarks for the user, a line each.

    Raises:
        UserError, RunStopped, Interrupted: see `training.loop.run_geometry`.
    """
    started = time.monotonic()
    prepare_folder(scene, config, folder, resume, command)
    guidance = DiffusionGuidance.load(config.guidance)
    unknown = guidance.set_prompt(scene.prompt, scene.negative_prompt)
    if unknown:
        say(
            f"the prompt's {', '.join(map(repr, unknown))} {'is' if len(unknown) == 1 else 'are'} outside the built-in prior's "
            "vocabulary and will not steer the result; `fd_mitsuba prior` lists the words it knows"
        )
    stage = GeometryStage(scene, config, guidance)
    run_geometry(stage, folder, resume, quiet, say)
    metrics = export_geometry(stage, folder)
    metrics["seconds"] = round(time.monotonic() - started, 1)
    write_atomically(folder / "metrics.json", (json.dumps(metrics, indent=2) + "\n").encode())
    return metrics


def prepare_folder(scene: EditScene, config: RunConfig, folder: Path, resume: bool, command: str) -> None:
    """Make the run folder and write down what the run is made of: command, settings, environment, the scene's files.

    Raises:
        UserError: the folder holds something else, or an interrupted run without `resume`, or cannot be written.
    """
    settings = json.dumps(config.model_dump(mode="json"), indent=2) + "\n"
    identity = {"scene": str(scene.path.resolve()), "prompt": scene.prompt, "parameters": scene.parameters,
                "config_hash": config.content_hash()}
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; choose another -o folder")
    if folder.exists() and any(folder.iterdir()):
        known = (folder / "run.json").exists() or (folder / "command.txt").exists()
        if not known:
            raise UserError(f"{folder}: not empty and not a run; choose another -o folder")
        if not resume:
            raise UserError(f"{folder}: holds a run already; add --resume to go on with it, or choose another -o folder")
        _refuse_other_run(folder, identity)
    write_atomically(folder / "command.txt", (command + "\n").encode())
    write_atomically(folder / "config.json", settings.encode())
    write_atomically(folder / "environment.json", (json.dumps(_environment(), indent=2) + "\n").encode())
    _copy_scene(scene, folder / "scene")
    write_atomically(folder / "run.json", (json.dumps(identity, indent=2) + "\n").encode())


def load_finished_stage(scene: EditScene, config: RunConfig, folder: Path) -> GeometryStage:
    """The geometry stage of a run folder at its newest checkpoint, without guidance; UserError if there is none."""
    stage = GeometryStage(scene, config, None)
    if not list_checkpoints(folder / "checkpoints"):
        raise UserError(f"{folder / 'checkpoints'}: no checkpoint; run the geometry stage first")
    load_newest(folder / "checkpoints", STAGE, config.content_hash(), stage.field, stage.optimiser)
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
    write_video(render_ring(edited, output.turntable_frames, output.turntable_size, aim), folder / "videos" / "turntable.mp4")
    size = min(output.turntable_size, 192)
    rows = {
        "base": render_ring((stage.base_surface.vertices, stage.base_surface.faces), _SHEET_VIEWS, size, aim),
        "base with the focal regions": render_ring((start.vertices, start.faces), _SHEET_VIEWS, size, aim),
        f"result: {stage.scene.prompt}": render_ring(edited, _SHEET_VIEWS, size, aim),
        "part": render_ring(part, _SHEET_VIEWS, size, aim),
    }
    write_sheet(rows, folder / "images" / "turntable.png")


def _refuse_other_run(folder: Path, identity: dict) -> None:
    path = folder / "run.json"
    if not path.exists():
        return
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        raise UserError(f"{path}: cannot be read; choose another -o folder") from None
    for key, value in identity.items():
        if known.get(key) != value:
            raise UserError(
                f"{folder}: holds a run with another {key.replace('_', ' ')} ({known.get(key)!r}, now {value!r}); "
                "resume with the run's own scene, -c, --set and -D, or choose another -o folder"
            )


def _copy_scene(scene: EditScene, folder: Path) -> None:
    """Copies of every file that the scene reads, flat, for the record; the run itself reads the originals."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in scene.files:
            target = folder / Path(file).name
            if not target.exists():
                shutil.copyfile(file, target)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror}); free space or choose another -o folder") from None


def _environment() -> dict[str, str | int]:
    names = ("mitsuba", "drjit", "torch", "diffusers", "transformers", "numpy", "libigl")
    return {
        "fd_mitsuba": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": torch.get_num_threads(),
        **{name: metadata.version(name) for name in names},
    }
