"""Scene and settings in, run folder out: what `fd_mitsuba run` does, as a Python API."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fd_mitsuba import __version__
from fd_mitsuba.appearance import (
    CUTS_UNKNOWN,
    finished_appearance,
    opened_base,
    parts_of_run,
    prepare_appearance,
    write_appearance,
)
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.locality import measure_locality
from fd_mitsuba.evaluation.turntable import render_ring, write_sheet, write_video
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.export.cut_shapes import CutBase, cut_base
from fd_mitsuba.export.meshes import copy_base, ply_bytes, write_mesh
from fd_mitsuba.export.part_record import part_file, part_record
from fd_mitsuba.export.part_solid import part_solid
from fd_mitsuba.export.solid import LEAST_FACES, Solid
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.prompt_check import take_prompt
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.region_mode import cut_faces_name
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.training.appearance_stage import AppearanceStage
from fd_mitsuba.training.checkpoint import checkpoint_folder, list_checkpoints, load_trained, write_atomically
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.run_folder import check_folder, describe_run, discarded_without_checkpoint, write_json
from fd_mitsuba.training.saved_run import saved_run

STAGES = ("geometry", "appearance")
_SHEET_VIEWS = 8


def run(
    scene: EditScene,
    config: RunConfig,
    folder: Path,
    resume: bool = False,
    command: str = "",
    quiet: bool = False,
    say: Callable[[str], None] = print,
    stages: Collection[str] = STAGES,
    geometry_from: Path | None = None,
) -> dict:
    """Grow the part, give it its material, and write the run folder; returns what `metrics.json` holds.

    Args:
        folder: made if it is missing; must be empty, or hold a run of the same scene and settings to go on with.
        resume: go on with the run in `folder`.
        command: the command line, for the record.
        say: takes remarks for the user, a line each.
        stages: which of `STAGES` to run. The appearance stage alone needs a folder whose geometry stage is finished.
        geometry_from: another run folder, whose finished geometry is taken over instead of running that stage.

    Raises:
        UserError, RunStopped, Interrupted: see `training.loop.run_stage`. A run that ends with an error before its
            first checkpoint leaves no folder behind.
    """
    started = time.monotonic()
    asked, with_assets = stages, "appearance" in stages
    if scene.subtracts and with_assets and config.appearance.lambda_sds > 0 and config.guidance.model == "builtin":
        if "geometry" not in stages:
            raise UserError(f"{scene.path}: {CUTS_UNKNOWN}")
        say(f"{CUTS_UNKNOWN}; so only the geometry stage runs, and the cut takes the base's material")
        stages = ("geometry",)
    with_geometry = "geometry" in stages and geometry_from is None
    check_folder(scene, config, folder, resume or (not with_geometry and geometry_from is None))
    # Nothing is written before the guidance is there: a wrong model name must not leave a folder that is taken.
    guidance = _guidance(scene, config, say) if with_geometry else None
    # Both priors know the same words: what the geometry stage has said of them is not said again.
    listener = (lambda line: None) if guidance is not None else say
    for_appearance = prepare_appearance(scene, config, say, listener, guidance) if "appearance" in stages else None
    if with_geometry:
        geometry = GeometryStage(scene, config, guidance)
        with discarded_without_checkpoint(folder):
            describe_run(scene, config, folder, command)
            run_stage(geometry, folder, resume, quiet, say)
    elif geometry_from is not None:
        refuse_other_shape(saved_run(geometry_from)[0], scene, geometry_from)
        geometry = load_finished_stage(scene, config, geometry_from)
        describe_run(scene, config, folder, command)
        take_geometry(geometry_from, folder)
    else:
        geometry = load_finished_stage(scene, config, folder)
    metrics = export_geometry(geometry, folder)

    def write_metrics() -> None:
        metrics["seconds"] = round(time.monotonic() - started, 1)
        metrics["peak_memory_mb"] = _peak_memory_mb()
        write_json(folder / "metrics.json", metrics)

    write_metrics()
    field = None
    if "appearance" in stages:
        appearance = AppearanceStage(
            scene, config, parts_of_run(scene, folder), for_appearance, say, opened_base(scene, folder)
        )
        run_stage(appearance, folder, resume, quiet, say)
        field, metrics["appearance"] = appearance.field, write_appearance(appearance, folder)
        write_metrics()
    if with_assets:
        write_assets(geometry, field, folder, ("glb", "mitsuba"), config.output.texture_size, say)
    # Written last of all: a folder without it is not finished.
    done = {"geometry", *stages}
    metrics["stages"] = {name: "done" if name in done else "left out" for name in STAGES if name in {*done, *asked}}
    write_metrics()
    return metrics


def refuse_other_shape(before: EditScene, now: EditScene, source: Path) -> None:
    """UserError if a run's scene has another base or other focal regions; light, materials and prompt may differ."""
    same_base = all(
        np.array_equal(getattr(before.base_soup, name), getattr(now.base_soup, name)) for name in ("vertices", "faces")
    )

    def places(scene: EditScene) -> list[tuple]:
        return [(region.name, region.part, region.mode, region.to_canonical.tobytes()) for region in scene.regions]

    if not same_base or places(before) != places(now):
        raise UserError(f"{source}: its base or its focal regions are others than those of {now.path}; run anew")


def take_geometry(source: Path, folder: Path) -> None:
    """Copy the newest geometry checkpoint of another run, which `load_finished_stage` has accepted."""
    newest = list_checkpoints(checkpoint_folder(source, GeometryStage.name))[-1]
    write_atomically(checkpoint_folder(folder, GeometryStage.name) / newest.name, newest.read_bytes())


def load_finished_stage(scene: EditScene, config: RunConfig, folder: Path) -> GeometryStage:
    """The geometry stage of a run folder at its newest checkpoint, without guidance; UserError if there is none."""
    stage = GeometryStage(scene, config, None)
    if not load_trained(folder, stage, config.content_hash(stage.name)):
        raise UserError(f"{checkpoint_folder(folder, stage.name)}: no checkpoint; run the geometry stage first")
    return stage


def export_geometry(stage: GeometryStage, folder: Path) -> dict:
    """Write meshes, turntable and contact sheet of the stage's present state; returns the measured figures."""
    scene, config, export = stage.scene, stage.config, folder / "export"
    with torch.no_grad():
        union = stage.surface()
    parts = {name: part_solid(stage, name) for name in scene.parts}
    figures: dict[str, Any] = {}
    opened = None
    if scene.subtracts:
        cut = _cut(scene, parts)
        figures = cut.figures
        for name, data in (cut.files() | cut.files(opened=True)).items():
            write_atomically(export / name, data)
        for name, mesh in cut.faces.items():
            write_atomically(export / f"{cut_faces_name(name)}.ply", ply_bytes(mesh.vertices, mesh.faces))
        parts, opened = _removed(scene, cut), cut.names(opened=True)
    for name, solid in parts.items():
        if len(solid.faces):
            write_mesh(export / part_file(name), solid.vertices, solid.faces, scene)
    write_json(export / "part.json", part_record(scene, parts, opened))
    write_mesh(export / "assembled.ply", union.vertices.numpy(), union.faces.numpy(), scene)
    identical = copy_base(scene, export / "base")
    # Locality is a matter of the part as it grew: the rim inside the base is put there on purpose.
    grown = tuple(tensor.numpy() for tensor in stage.extractor.extract_part(stage.field))
    base = scene.base_canonical
    locality = measure_locality(grown, (base.vertices, base.faces), scene.regions, config.geometry.focal_band)
    whole = next(iter(parts.values())) if len(parts) == 1 else part_solid(stage, None)
    _write_turntable(stage, (torch.from_numpy(whole.vertices), torch.from_numpy(whole.faces)), folder)
    return {
        "version": __version__,
        "prompt": scene.prompt,
        "seed": config.seed,
        "steps": config.geometry.steps,
        "guidance_model": config.guidance.model,
        **asdict(locality),
        "base_identical": identical,
        "part_faces": {name: len(solid.faces) for name, solid in parts.items()},
        "manifold": all(solid.manifold for solid in parts.values()),
        "islands_removed": whole.islands_removed,
        "bridged": whole.bridged,
        "gap": whole.gap(base),
        "assembled_faces": len(union.faces),
        **figures,
    }


def export_run(
    folder: Path,
    formats: Collection[str],
    texture_size: int,
    say: Callable[[str], None] = print,
    faces: int | None = None,
) -> dict[str, Any]:
    """Write the assets of a run, finished or interrupted, as of its newest checkpoint; see `export.assets`.

    Args:
        faces: at most so many triangles a part; None: all.

    Raises:
        UserError: no run or no checkpoint there, and see `export.assets.export_assets`.
    """
    if faces is not None and faces < LEAST_FACES:
        raise UserError(f"--faces {faces}: give {LEAST_FACES} or more")
    scene, config = saved_run(folder)
    geometry = load_finished_stage(scene, config, folder)
    appearance = finished_appearance(scene, config, folder)
    field = None if appearance is None else appearance.field
    return write_assets(geometry, field, folder, formats, texture_size, say, faces)


def write_assets(
    geometry: GeometryStage,
    field: TextureField | None,
    folder: Path,
    formats: Collection[str],
    texture_size: int,
    say: Callable[[str], None],
    faces: int | None = None,
) -> dict[str, Any]:
    """Write the assets of the stages' present state below `folder`; returns what `export.assets` says of them.

    Args:
        field: the parts' learned material; None: the constants of the scene's part BSDF.
        faces: at most so many triangles a part; None: all.
    """
    scene = geometry.scene
    solids = {name: part_solid(geometry, name) for name in scene.parts}
    if faces is not None:
        solids = {name: solid.decimated(faces) for name, solid in solids.items()}
    cut = _cut(scene, solids) if scene.subtracts else None
    if cut is not None:
        solids = _removed(scene, cut)
    parts = {name: PartAsset(scene.frame.to_user(solid.vertices), solid.faces, field) for name, solid in solids.items()}
    opened = None if cut is None else cut.names(opened=True)
    write_json(folder / "export" / "part.json", part_record(scene, solids, opened))
    export = folder / "export"
    return export_assets(scene, geometry.config, parts, export, formats, texture_size, say, cut, faces)


def _cut(scene: EditScene, solids: dict[str, Solid]) -> CutBase:
    return cut_base(scene, SceneFile(scene.path, scene.parameters), solids)


def _removed(scene: EditScene, cut: CutBase) -> dict[str, Solid]:
    """What each part took away, in the canonical frame."""
    return {name: solid.moved(scene.frame.matrix()) for name, solid in cut.removed.items()}


def _write_turntable(stage: GeometryStage, part: tuple[torch.Tensor, torch.Tensor], folder: Path) -> None:
    output, aim = stage.config.output, stage.aim
    with torch.no_grad():
        union = stage.surface()
    start = stage.start_surface()
    edited = (union.vertices, union.faces)
    base = (stage.base_surface.vertices, stage.base_surface.faces)
    for name, mesh in {"turntable": edited, "turntable_base": base, "turntable_part": part}.items():
        frames = render_ring(mesh, output.turntable_frames, output.turntable_size, aim)
        write_video(frames, folder / "videos" / f"{name}.mp4")
    size = min(output.turntable_size, 192)
    rows = {
        "base": render_ring(base, _SHEET_VIEWS, size, aim),
        "base with the focal regions": render_ring((start.vertices, start.faces), _SHEET_VIEWS, size, aim),
        f"result: {stage.scene.prompt}": render_ring(edited, _SHEET_VIEWS, size, aim),
        "part": render_ring(part, _SHEET_VIEWS, size, aim),
    }
    write_sheet(rows, folder / "images" / "turntable.png")


def _guidance(scene: EditScene, config: RunConfig, say: Callable[[str], None]) -> DiffusionGuidance | None:
    if config.geometry.lambda_sds == 0:
        return None
    guidance = DiffusionGuidance.load(config.guidance)
    if guidance.conventions.vocabulary is not None and scene.subtracts:
        raise UserError(
            f"{scene.path}: its regions subtract, and the built-in prior knows only parts that are added; set "
            "geometry.lambda_sds=0 to cut out the regions themselves, or guidance.model to a Stable Diffusion folder"
        )
    take_prompt(guidance, scene.prompt, scene.negative_prompt, say)
    return guidance


def _peak_memory_mb() -> int:
    """The most memory that this process has held so far, in units of 2^20 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))
