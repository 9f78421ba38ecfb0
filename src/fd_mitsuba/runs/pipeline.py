"""Scene and settings in, run folder out: what `fd_mitsuba run` and `api.edit` do."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fd_mitsuba.backend.collector import long_lived
from fd_mitsuba.backend.peak_memory import peak_memory_mb
from fd_mitsuba.backend.processes import processes
from fd_mitsuba.backend.threads import rendering_threads
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.conventions import STAGES
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.assets import PartAsset, chosen_exporters, export_assets
from fd_mitsuba.export.final_surface.final_part import FinalPart, final_parts
from fd_mitsuba.export.part_record import part_record
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.fields.textures_apart import TexturesApart
from fd_mitsuba.guidance.interface import Guidance
from fd_mitsuba.io.json_object import write_json
from fd_mitsuba.runs.appearance_outcome import (
    CUTS_UNKNOWN,
    cuts_stay_plain,
    finished_appearance,
    opened_base,
    parts_of_run,
    prepare_appearance,
    write_appearance,
)
from fd_mitsuba.runs.choices import checked_choices
from fd_mitsuba.runs.cost_memory import memory_warning, run_memory
from fd_mitsuba.runs.follower import refuse_guidance_alone
from fd_mitsuba.runs.geometry_outcome import (
    cut_out,
    export_geometry,
    load_finished_stage,
    prepare_geometry,
    refuse_other_shape,
    removed_parts,
    take_geometry,
)
from fd_mitsuba.runs.levels import checked_levels, level_folder, remove_other_levels, within_budget
from fd_mitsuba.runs.network_size import network_size
from fd_mitsuba.runs.outcome_warnings import outcome_warnings
from fd_mitsuba.runs.photographs import write_photographs
from fd_mitsuba.runs.prompt_fit import prompt_warnings
from fd_mitsuba.runs.run_folder import check_folder, describe_run, discarded_without_checkpoint, refuse_strange_folder
from fd_mitsuba.runs.run_lock import run_lock
from fd_mitsuba.runs.saved_run import saved_run
from fd_mitsuba.runs.scene_model import model_for_run
from fd_mitsuba.runs.scene_size import SceneSize
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.region_place import refuse_hidden_parts
from fd_mitsuba.training.appearance_stage import AppearanceStage
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.stage import OnStep


class SaysWhatItSees(Protocol):
    """A verdict on a shape: `evaluation.verdict.Verdict` is the one that the package ships."""

    def line(self) -> str:
        """For people."""
        ...

    def to_json(self) -> dict[str, Any]:
        """What `metrics.json` holds."""
        ...


Judge = Callable[[GeometryStage, Callable[[str], None]], SaysWhatItSees | None]
"""Given a finished stage and where remarks go; None where it cannot say anything."""


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
    guidance: Guidance | None = None,
    on_step: OnStep | None = None,
    opening: Sequence[str] = (),
    judge: Judge | None = None,
) -> dict:
    """Grow the part, give it its material, and write the run folder; returns what `metrics.json` holds.

    Args:
        folder: made if it is missing; must be empty, or hold a run of the same scene and settings to go on with.
        resume: go on with the run in `folder`.
        command: the command line, for the record.
        say: takes log lines and warnings for the user.
        stages: which of `STAGES` to run. The appearance stage alone needs a folder whose geometry stage is finished.
        geometry_from: another run folder, whose finished geometry is taken over instead of running that stage.
        guidance: a caller's own, in place of the model that the settings name. The appearance stage takes it too where
            it has `guide_appearance`, and otherwise loads the settings' model.
        on_step: called after each finished step of either stage.
        judge: says whether the finished shape looks like the prompt; None: nobody does.
        opening: lines for `say` once the input has been found to be good: a refusal stays the only line.

    Raises:
        UserError, RunStopped, Interrupted: see `training.loop.run_stage`. A run that ends with an error before its
            first checkpoint leaves no folder behind.
    """
    refuse_strange_folder(folder)
    with run_lock(folder, say), ExitStack() as until_done:
        started = time.monotonic()
        config = checked_choices(config)
        if guidance is None:
            config, chosen = model_for_run(config, scene, folder)
            warnings = [f"warning: {line}" for line in prompt_warnings(scene, config)]
            opening = [*opening, *([chosen] if chosen else []), *warnings]
        refuse_hidden_parts(scene.path, scene.regions, scene.base_canonical)
        if guidance is not None:
            refuse_guidance_alone(guidance)
        asked, with_assets = stages, "appearance" in stages
        if with_assets and cuts_stay_plain(scene, config, guidance):
            if "geometry" not in stages:
                raise UserError(f"{scene.path}: {CUTS_UNKNOWN}")
            say(f"{CUTS_UNKNOWN}; so only the geometry stage runs, and the cut takes the base's material")
            stages = ("geometry",)
        with_geometry = "geometry" in stages and geometry_from is None
        for line in check_folder(scene, config, folder, resume or (not with_geometry and geometry_from is None)):
            say(line)
        terms = run_memory(SceneSize.of(scene), config, tuple(stages), network_size(config.guidance.model))
        if warning := memory_warning(scene, terms):
            say(warning)
        # Nothing is written before the guidance is there: a wrong model name must not leave a folder that is taken.
        for_geometry = prepare_geometry(scene, config, say, guidance) if with_geometry else None
        for_appearance = None
        if "appearance" in stages:
            # Both priors know the same words: what the geometry stage has said of them is not said again.
            listener = (lambda line: None) if for_geometry is not None else say
            loaded = for_geometry if guidance is None else None
            for_appearance = prepare_appearance(scene, config, say, listener, loaded, guidance)

        for own in (for_geometry, for_appearance):
            refuse_guidance_alone(own)
        until_done.enter_context(long_lived())

        def begin() -> None:
            for line in (*opening, *scene.warnings):
                say(line)
            describe_run(scene, config, folder, command)

        if with_geometry:
            geometry = GeometryStage(scene, config, for_geometry)
            with discarded_without_checkpoint(folder):
                begin()
                run_stage(geometry, folder, resume, quiet, say, on_step)
        elif geometry_from is not None:
            refuse_other_shape(saved_run(geometry_from, say=say)[0], scene, geometry_from)
            geometry = load_finished_stage(scene, config, geometry_from)
            with discarded_without_checkpoint(folder):
                begin()
                take_geometry(geometry_from, folder)
        else:
            geometry = load_finished_stage(scene, config, folder)
            begin()
        with rendering_threads():
            finished = final_parts(geometry.grown(), config.output.faces, say)
            metrics = export_geometry(geometry, folder, finished)
        if guidance is not None:
            metrics["guidance_model"] = f"{type(guidance).__module__}.{type(guidance).__qualname__}"
        verdict = None
        if judge is not None:
            with rendering_threads():
                verdict = judge(geometry, say)
        if verdict is not None:
            metrics["verdict"] = verdict.to_json()

        def write_metrics() -> None:
            metrics["seconds"] = round(time.monotonic() - started, 1)
            metrics["peak_memory_mb"] = peak_memory_mb()
            write_json(folder / "metrics.json", metrics)

        write_metrics()
        processes().wait()  # the parts are there for the others
        field = None
        if "appearance" in stages:
            appearance = AppearanceStage(
                scene, config, parts_of_run(scene, folder), for_appearance, say, opened_base(scene, folder)
            )
            run_stage(appearance, folder, resume, quiet, say, on_step)
            with rendering_threads():
                field, metrics["appearance"] = appearance.field, write_appearance(appearance, folder)
            write_metrics()
        if with_assets:
            with rendering_threads():
                write_assets(geometry, finished, field, folder, ("glb", "mitsuba"), config.output.texture_size, say)
                if config.output.picture_size:
                    write_photographs(scene, folder, config.output, say)
        metrics["warnings"] = outcome_warnings(metrics)
        # Written last of all: a folder without it is not finished.
        done = {"geometry", *stages}
        metrics["stages"] = {name: "done" if name in done else "left out" for name in STAGES if name in {*done, *asked}}
        write_metrics()
        if verdict is not None:
            say(verdict.line())
        return metrics


def export_run(
    folder: Path,
    formats: Collection[str | Choice],
    texture_size: int,
    say: Callable[[str], None] = print,
    faces: int | Sequence[int] | None = None,
) -> dict[str, Any]:
    """Write the assets of a run, finished or interrupted, as of its newest checkpoint; see `export.assets`.

    Args:
        faces: at most so many triangles a part; None: as many as in the run's settings. Of several, each is a level of
            detail: the largest is written as ever, the others below `export/lod_<faces>`, each with its own textures.

    Raises:
        UserError: no run or no checkpoint there, budgets that cannot be, and see `export.assets.export_assets`.
    """
    levels = checked_levels(faces)
    chosen_exporters(formats)  # an unknown one is said before anything is loaded
    scene, config = saved_run(folder, say=say)
    with run_lock(folder, say):
        geometry = load_finished_stage(scene, config, folder)
        appearance = finished_appearance(scene, config, folder)
        field = None if appearance is None else appearance.field
        finished = final_parts(geometry.grown(), max([*levels, config.output.faces]), say)
        first = levels[0] if levels else None
        settings = (formats, texture_size, say)
        written = write_assets(geometry, finished, field, folder, *settings, first, tuple(levels[1:]))
        for level in levels[1:]:
            below = level_folder(Path(), level)
            more = write_assets(geometry, finished, field, folder, *settings, level, below=below)
            written["files"] += [f"{below}/{name}" for name in more["files"]]
            written.setdefault("levels", {})[str(below)] = more["part_faces"]
        remove_other_levels(folder / "export", levels[1:])
        return written


def write_assets(
    geometry: GeometryStage,
    finished: Mapping[str, FinalPart],
    field: TextureField | TexturesApart | None,
    folder: Path,
    formats: Collection[str | Choice],
    texture_size: int,
    say: Callable[[str], None],
    faces: int | None = None,
    levels: tuple[int, ...] = (),
    below: Path | None = None,
) -> dict[str, Any]:
    """Write the assets of the stages' present state below `folder`; returns what `export.assets` says of them.

    Args:
        finished: the final surface of every part, see `final_parts`.
        field: the parts' learned material; None: the constants of the scene's part BSDF.
        faces: at most so many triangles a part; None: all that there are.
        levels: further levels that are written besides, for the record.
        below: a folder in `folder/export` to write to, of a level of detail.
    """
    scene = geometry.scene
    if faces is not None:
        unit = 1.0 / scene.frame.scale
        finished = {name: within_budget(name, part, faces, say, unit) for name, part in finished.items()}
    solids = {name: part.solid for name, part in finished.items()}
    normals: dict[str, np.ndarray | None] = {name: part.normals for name, part in finished.items()}
    cut = cut_out(scene, solids) if scene.subtracts else None
    if cut is not None:
        solids, normals = removed_parts(scene, cut), {}
    parts = {
        name: PartAsset(scene.frame.to_user(solid.vertices), solid.faces, field, normals.get(name))
        for name, solid in solids.items()
    }
    opened = None if cut is None else cut.names(opened=True)
    export = folder / "export"
    target = export if below is None else export / below
    record = part_record(scene, solids, opened)
    write_json(target / "part.json", record)
    budgets = None if faces is None else (faces, *levels)
    states = None if below is None else export
    written = export_assets(scene, geometry.config, parts, target, formats, texture_size, say, cut, budgets, states)
    for name, noise in written["shading_noise_deg"].items():
        record["parts"].get(name, {})["shading_noise_deg"] = noise
    write_json(target / "part.json", record)
    return written
