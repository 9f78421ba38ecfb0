"""The geometry stage within a run: its guidance, its outcome in another folder, the meshes and images it leaves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fd_mitsuba import __version__
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.cut_shapes import CutBase, cut_base
from fd_mitsuba.export.final_surface.final_part import FinalPart
from fd_mitsuba.export.meshes import copy_base, write_mesh
from fd_mitsuba.export.part_record import part_file, part_record
from fd_mitsuba.export.solid.part_solid import part_solid
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceGuidance, Guidance
from fd_mitsuba.guidance.prompt_check import take_prompt
from fd_mitsuba.guidance.sources import load_guidance
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.json_object import write_json
from fd_mitsuba.io.ply import ply_bytes
from fd_mitsuba.runs.locality import measure_locality
from fd_mitsuba.runs.own_meshes import as_mesh, base_mesh, edited_mesh, start_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.region_mode import cut_faces_name
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.training.checkpoint import checkpoint_folder, list_checkpoints, load_trained
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.viewing.turntable import render_ring, write_sheet, write_video

_SHEET_VIEWS = 8


def prepare_geometry(
    scene: EditScene, config: RunConfig, say: Callable[[str], None], given: Guidance | None = None
) -> Guidance | None:
    """The guidance of the geometry stage with the scene's prompt; None where it has no weight.

    Args:
        given: a caller's own guidance, in place of the one that `guidance.kind` and `guidance.model` name.

    Raises:
        UserError: a model that cannot be loaded, a prompt or a cut that it cannot guide; see `take_prompt`.
    """
    if config.geometry.lambda_sds == 0:
        return None
    guidance = load_guidance(config) if given is None else given
    if given is not None or not isinstance(guidance, DiffusionGuidance):
        return with_prompt(guidance, scene, say)
    texts = texts_of_parts(scene)
    take_prompt(guidance, scene.prompt, scene.negative_prompt, say, scene.base_prompt, texts, scene.subtracts)
    return guidance


def with_prompt(given: Guidance | AppearanceGuidance, scene: EditScene, say: Callable[[str], None]) -> Any:
    """A caller's own guidance with the scene's prompts; the words that it does not know are logged.

    Raises:
        UserError: focal regions have prompts, and the guidance takes none of parts.
    """
    texts = texts_of_parts(scene)
    take_texts = getattr(given, "set_part_prompts", None)
    if texts and take_texts is None:
        raise UserError(
            f"{scene.path}: part {next(iter(texts))!r} has a prompt of its own, which {type(given).__name__} cannot "
            "take; remove the prompts of the focal regions, or give the guidance set_part_prompts"
        )
    unknown = given.set_prompt(scene.prompt, scene.negative_prompt)
    if take_texts is not None:
        take_texts(texts)
    if unknown:
        say(f"{type(given).__name__} does not know {', '.join(map(repr, unknown))}")
    return given


def texts_of_parts(scene: EditScene) -> dict[str, tuple[str, str]]:
    """Part -> prompt and negative prompt, of the parts that have their own, as guidances take them."""
    return {part: (own.prompt, own.negative_prompt) for part, own in scene.part_prompts.items()}


def refuse_other_shape(before: EditScene, now: EditScene, source: Path) -> None:
    """UserError if a run's scene has another base or other focal regions; light, materials and prompt may differ."""
    same_base = all(
        np.array_equal(getattr(before.base_soup, name), getattr(now.base_soup, name)) for name in ("vertices", "faces")
    )

    def places(scene: EditScene) -> list[tuple]:
        return [
            (region.name, region.part, region.mode, region.to_canonical.tobytes(), _mesh_bytes(region.mesh))
            for region in scene.regions
        ]

    if not same_base or places(before) != places(now):
        raise UserError(f"{source}: its base or its focal regions are others than those of {now.path}; run anew")


def _mesh_bytes(mesh: TriangleMesh | None) -> bytes:
    return b"" if mesh is None else mesh.vertices.tobytes() + mesh.faces.tobytes()


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


def export_geometry(stage: GeometryStage, folder: Path, finished: Mapping[str, FinalPart]) -> dict:
    """Write meshes, turntable and contact sheet of the stage's present state; returns the measured metrics.

    Args:
        finished: the final surface of every part, see `final_parts`.
    """
    scene, config, export = stage.scene, stage.config, folder / "export"
    with torch.no_grad():
        union = stage.surface()
    parts = {name: part.solid for name, part in finished.items()}
    figures: dict[str, Any] = {}
    opened = cut = None
    if scene.subtracts:
        cut = cut_out(scene, parts)
        figures = cut.figures
        for name, data in (cut.files() | cut.files(opened=True)).items():
            write_atomically(export / name, data)
        for name, mesh in cut.faces.items():
            write_atomically(export / f"{cut_faces_name(name)}.ply", ply_bytes(mesh.vertices, mesh.faces))
        parts, opened = removed_parts(scene, cut), cut.names(opened=True)
    for name, solid in parts.items():
        if len(solid.faces):
            write_mesh(export / part_file(name), solid.vertices, solid.faces, scene)
    record = part_record(scene, parts, opened)
    write_json(export / "part.json", record)
    assembled = Solid(union.vertices.numpy(), union.faces.numpy())
    if cut is not None and cut.crumbs:
        there, back = np.linalg.inv(scene.frame.matrix()), scene.frame.matrix()
        margin = 2 * stage.grid.spacing / scene.frame.scale
        assembled = cut.without_crumbs(assembled.moved(there), margin).moved(back)
    write_mesh(export / "assembled.ply", assembled.vertices, assembled.faces, scene)
    identical = copy_base(scene, export / "base")
    # Locality is a matter of the part as it grew: the rim inside the base is put there on purpose.
    vertices, faces = stage.extractor.extract_part(stage.final_field)
    base, grown = scene.base_canonical, (vertices.numpy(), faces.numpy())
    locality = measure_locality(grown, (base.vertices, base.faces), scene.regions, config.geometry.focal_band)
    # Parts may join the base through each other, so that their gaps are those of all together.
    whole = next(iter(parts.values())) if len(parts) == 1 else part_solid(stage.grown(), None)
    _write_turntable(stage, whole, cut, folder)
    return {
        "version": __version__,
        "prompt": scene.prompt,
        "seed": config.seed,
        "steps": config.geometry.steps,
        "guidance_model": config.guidance.source,
        **asdict(locality),
        "base_identical": identical,
        "part_faces": {name: len(solid.faces) for name, solid in parts.items()},
        "manifold": all(solid.manifold for solid in parts.values()),
        "islands_removed": whole.islands_removed,
        "bridged": whole.bridged,
        "gap": whole.gap(base),
        **_walls_and_ends(record["parts"]),
        "assembled_faces": len(assembled.faces),
        **figures,
    }


def _walls_and_ends(parts: Mapping[str, dict]) -> dict[str, Any]:
    """Of the parts in `part.json`: the thinnest wall of each, and the ends that hang free; in the scene's unit."""
    walls = {name: part["walls"]["least"] for name, part in parts.items() if "walls" in part}
    ends = [{"part": name, **end} for name, part in parts.items() for end in part.get("contacts", []) if end["gap"] > 0]
    return {"least_wall": walls, "free_ends": ends}


def cut_out(scene: EditScene, solids: dict[str, Solid]) -> CutBase:
    """What the parts of a scene that subtracts take away, and what they leave of the base."""
    return cut_base(scene, scene.inputs.scene, solids)


def removed_parts(scene: EditScene, cut: CutBase) -> dict[str, Solid]:
    """What each part took away, in the canonical frame."""
    return {name: solid.moved(scene.frame.matrix()) for name, solid in cut.removed.items()}


def _write_turntable(stage: GeometryStage, part: Solid, cut: CutBase | None, folder: Path) -> None:
    """Videos and the contact sheet. The base is drawn with its own triangles, not as a grid of the run sees it."""
    scene, output, aim = stage.scene, stage.config.output, stage.aim
    base, edited, alone = base_mesh(scene), edited_mesh(scene, part, cut), as_mesh(part.vertices, part.faces)
    for name, mesh in {"turntable": edited, "turntable_base": base, "turntable_part": alone}.items():
        frames = render_ring(mesh, output.turntable_frames, output.turntable_size, aim)
        write_video(frames, folder / "videos" / f"{name}.mp4")
    size = min(output.turntable_size, 192)
    rows = {
        "base": render_ring(base, _SHEET_VIEWS, size, aim),
        "base with the focal regions": render_ring(start_mesh(scene), _SHEET_VIEWS, size, aim),
        f"result: {scene.prompt}": render_ring(edited, _SHEET_VIEWS, size, aim),
        "part": render_ring(alone, _SHEET_VIEWS, size, aim),
    }
    write_sheet(rows, folder / "images" / "turntable.png")
