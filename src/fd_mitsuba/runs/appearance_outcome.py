"""The appearance stage of a run folder: from its parts' meshes to learned materials, images and metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.bake.shading_noise import widened_roughness
from fd_mitsuba.export.part_record import part_file
from fd_mitsuba.fields.texture import TextureValues
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceGuidance, Guidance
from fd_mitsuba.guidance.prompt_check import take_prompt
from fd_mitsuba.guidance.sources import load_guidance
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.io.ply import read_ply
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.gbuffer import GBuffer
from fd_mitsuba.runs.cost_memory import refuse_too_many_samples
from fd_mitsuba.runs.geometry_outcome import texts_of_parts, with_prompt
from fd_mitsuba.runs.preservation import measure_preservation
from fd_mitsuba.runs.saved_run import saved_run
from fd_mitsuba.scene.appearance_inputs import check_appearance_inputs
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.region_mode import cut_faces_name
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.training.appearance_stage import AppearanceStage
from fd_mitsuba.training.checkpoint import checkpoint_folder, list_checkpoints, load_trained
from fd_mitsuba.training.step_views import check_views
from fd_mitsuba.viewing.lit_views import VIEWS_AT_ONCE, lit_ring, ring_cameras
from fd_mitsuba.viewing.sheets import map_rows
from fd_mitsuba.viewing.turntable import write_sheet

_SHEET_VIEWS, _SHEET_SIZE, _SHEET_SPP = 8, 192, 12
_BRIGHTEST_BOUNCE = 1.0
"""What a sample may see by way of another surface in the images of `render_run`, in units of the image's white."""
CUTS_UNKNOWN = (
    "its regions subtract, and the built-in prior knows no faces of a cut; set appearance.lambda_sds=0 and "
    "appearance.style=true for faces that go on with the base's material, or guidance.model to a Stable Diffusion model"
)


def parts_of_run(scene: EditScene, folder: Path) -> dict[str, TriangleMesh]:
    """The parts' meshes that the geometry stage exported, canonical frame; where they are cut out, the cut's faces.

    Raises:
        UserError: a part is missing or empty.
    """
    parts = {}
    for name in scene.parts:
        path = folder / "export" / (f"{cut_faces_name(name)}.ply" if scene.subtracts else part_file(name))
        if not path.is_file():
            raise UserError(f"{path}: missing; run the geometry stage first (--stage geometry)")
        vertices, faces = read_ply(path)
        if not len(faces):
            raise UserError(f"{path}: is empty; run the geometry stage again (--resume)")
        parts[name] = TriangleMesh(name, scene.frame.to_canonical(vertices), faces, (path,))
    return parts


def opened_base(scene: EditScene, folder: Path) -> dict[int, Path | None] | None:
    """Where parts are cut out: number of a base shape -> the exported mesh of what is left of it without the faces of
    the cut; None: nothing. None for scenes that do not cut.

    Raises:
        UserError: the geometry stage has not been exported, or a file of it is gone.
    """
    if not scene.subtracts:
        return None
    record = folder / "export" / "part.json"
    names = (read_json_object(record) or {}).get("opened")
    if not isinstance(names, dict) or not all(
        number.isdecimal() and (name is None or (isinstance(name, str) and Path(name).name == name))
        for number, name in names.items()
    ):
        raise UserError(f"{record}: does not state what is left of the base; run the geometry stage anew")
    opened = {int(number): None if name is None else folder / "export" / name for number, name in names.items()}
    for path in opened.values():
        if path is not None and not path.is_file():
            raise UserError(f"{path}: missing; run the geometry stage anew (--stage geometry)")
    return opened


def _removed(scene: EditScene, folder: Path) -> list[np.ndarray] | None:
    """Vertices (V, 3) of what was cut out, in the frame of renders; None for scenes that do not cut."""
    paths = [folder / "export" / part_file(name) for name in scene.parts]
    return [read_ply(path)[0] - scene.origin for path in paths if path.is_file()] if scene.subtracts else None


def prepare_appearance(
    scene: EditScene,
    config: RunConfig,
    say: Callable[[str], None],
    say_of_prompt: Callable[[str], None],
    shared: Guidance | None = None,
    given: Guidance | None = None,
) -> AppearanceGuidance | None:
    """Check what the appearance stage needs of the scene, and load its guidance; before anyone waits for a run.

    Args:
        say: takes log lines about the scene, `say_of_prompt` those about the prompt's words.
        shared: the geometry stage's guidance, so that a large model is loaded once.
        given: a caller's own guidance, in place of the one that `guidance.kind` names. Whichever it is, where it has no
            `guide_appearance` the diffusion model of `guidance.model` takes this stage.

    Raises:
        UserError: see `check_appearance_inputs`, `part_material`, `DiffusionGuidance.load`, `check_views` and
            `take_prompt`.
    """
    for warning in check_appearance_inputs(scene):
        say(warning)
    # The stage asks again, but only after the shape is there: nobody shall wait for that to hear of a wrong material.
    part_material(scene, config.appearance.fixed, config.appearance.normal_map)
    if config.appearance.lambda_sds == 0:
        return None
    if (own := _own_guidance(config, shared, given)) is not None:
        check_views(AppearanceStage.name, config, own)
        return with_prompt(own, scene, say_of_prompt)
    if isinstance(shared, DiffusionGuidance):
        guidance = shared.for_appearance(config.appearance)
    else:
        guidance = DiffusionGuidance.load(config.guidance, appearance=config.appearance)
    if guidance.conventions.vocabulary is not None and scene.subtracts:
        raise UserError(f"{scene.path}: {CUTS_UNKNOWN}")
    check_views(AppearanceStage.name, config, guidance)
    texts = texts_of_parts(scene)
    take_prompt(guidance, scene.prompt, scene.negative_prompt, say_of_prompt, scene.base_prompt, texts)
    return guidance


def cuts_stay_plain(scene: EditScene, config: RunConfig, given: object = None) -> bool:
    """Whether the appearance stage is left out, because the built-in prior would guide it and knows no cuts.

    Args:
        given: a caller's own guidance.
    """
    diffusion = config.guidance.kind.kind == "diffusion"
    by_builtin = is_builtin(config.guidance.model) and diffusion and not hasattr(given, "guide_appearance")
    return scene.subtracts and config.appearance.lambda_sds > 0 and by_builtin


def _own_guidance(config: RunConfig, shared: Guidance | None, given: Guidance | None) -> AppearanceGuidance | None:
    """A caller's guidance or another module's, where it can guide the appearance."""
    found: Any = given
    if given is None and config.guidance.kind.kind != "diffusion":
        found = load_guidance(config) if shared is None else shared
    return found if hasattr(found, "guide_appearance") else None


def finished_appearance(
    scene: EditScene, config: RunConfig, folder: Path, max_depth: int | None = None
) -> AppearanceStage | None:
    """The appearance stage of a run at its newest checkpoint, without guidance; None if it has not begun.

    Args:
        max_depth: for images with more bounces of light than the stage was trained with.

    Raises:
        UserError: parts are missing, or every checkpoint is damaged.
    """
    if not list_checkpoints(checkpoint_folder(folder, AppearanceStage.name)):
        return None
    config_hash = config.content_hash(AppearanceStage.name)
    if max_depth is not None:
        config = config.model_copy(update={"appearance": config.appearance.model_copy(update={"max_depth": max_depth})})
    parts, opened = parts_of_run(scene, folder), opened_base(scene, folder)
    stage = AppearanceStage(scene, config, parts, None, lambda line: None, opened)
    load_trained(folder, stage, config_hash)
    return stage


def write_appearance(stage: AppearanceStage, folder: Path) -> dict:
    """Write the maps of the material to `images/channels.png`; returns the measured metrics."""
    output, rendering = stage.config.output, stage.rendering
    alone = AppearancePass(stage.scene, {}, stage.shading, rendering.size, rendering.spp)
    cameras, size = ring_cameras(_SHEET_VIEWS, stage.aim), min(output.turntable_size, _SHEET_SIZE)
    with torch.no_grad():
        gbuffer = rendering.trace(cameras, 0, size=size, spp=_SHEET_SPP)
        texture = stage.texture(gbuffer)
        pictures = stage.render(gbuffer, texture, 0)
    write_sheet(map_rows(gbuffer, pictures, texture, stage.exposure), folder / "images" / "channels.png")
    kept = measure_preservation(rendering, alone, cameras, stage.exposure, 128, 16, _removed(stage.scene, folder))
    return {
        **asdict(kept),
        "exposure": stage.exposure,
        "learned": list(stage.material.learned),
        **stage.check_field(stage.steps),
    }


def lit_turntable(
    stage: AppearanceStage, count: int, size: int, spp: int, noise_deg: Mapping[str, float] | None = None
) -> np.ndarray:
    """Frames (count, size, size, 3) uint8 of the finished object, front first.

    Args:
        noise_deg: part -> the noise that its exported roughness was widened for; see `widened_roughness`.
    """
    noises = [(noise_deg or {}).get(name, 0.0) for name in stage.parts]

    def shade(gbuffer: GBuffer, seed: int) -> torch.Tensor:
        texture = as_exported(stage.texture(gbuffer), gbuffer.part, noises)
        return stage.render(gbuffer, texture, seed).merged

    return lit_ring(stage.rendering, shade, ring_cameras(count, stage.aim), stage.exposure, size, spp)


def as_exported(texture: TextureValues, part: torch.Tensor, noises_deg: Sequence[float]) -> TextureValues:
    """A material at N points with the roughness that exports hold; no gradients.

    Args:
        part: (N,) int64, which part each point is of.
        noises_deg: of each part; 0: its roughness is as it was learned.
    """
    roughness = texture.roughness.detach().clone()
    for number, noise in enumerate(noises_deg):
        rows = part == number
        if noise > 0 and bool(rows.any()):
            roughness[rows] = torch.from_numpy(widened_roughness(roughness[rows].numpy(), noise))
    return replace(texture, roughness=roughness)


def exported_noise(folder: Path) -> dict[str, float]:
    """Part -> the noise that the exported roughness was widened for, as `part.json` states it."""
    parts = (read_json_object(folder / "export" / "part.json") or {}).get("parts")
    found = {}
    for name, part in (parts if isinstance(parts, dict) else {}).items():
        noise = part.get("shading_noise_deg") if isinstance(part, dict) else None
        if isinstance(noise, int | float) and not isinstance(noise, bool) and 0 <= noise <= 180:
            found[name] = float(noise)
    return found


def render_run(
    folder: Path,
    changed: dict[str, str],
    name: str,
    views: int,
    size: int,
    spp: int,
    max_depth: int,
    say: Callable[[str], None] = print,
) -> list[Path]:
    """Render a run's object all around, with other values for the scene's `$name`, such as another light.

    Writes `renders/<name>_NN.png` and the sheet `renders/<name>.png` below `folder` and returns their paths. The
    exposure is the run's own rule applied to the light at hand. Roughness is what the exports hold.

    Raises:
        UserError: no run, no appearance checkpoint, a size or count out of range, and see `load_edit_scene`.
    """
    given = f"--views {views} --size {size} --spp {spp} --depth {max_depth}"
    if views < 1 or size < 16 or spp < 1 or (max_depth < 2 and max_depth != -1):
        raise UserError(f"{given}: too small; raise it")
    if views > 1000 or size > 4096 or spp > 65536 or max_depth > 1000:
        raise UserError(f"{given}: too large; give at most 1000, 4096, 65536 and 1000")
    refuse_too_many_samples(min(views, VIEWS_AT_ONCE), size, spp, given)
    if Path(name).name != name:
        raise UserError(f"--output {name}: give a name without folders; images go to {folder / 'renders'}")
    scene, config = saved_run(folder, changed, say)
    stage = finished_appearance(scene, config, folder, max_depth)
    if stage is None:
        raise UserError(f"{folder}: its appearance stage has not begun; run it with --stage appearance")
    stage.set_bounces()
    stage.rendering.limit_bounces(_BRIGHTEST_BOUNCE / stage.exposure)
    noise = exported_noise(folder) if config.output.roughness_floor else {}
    frames = lit_turntable(stage, views, size, spp, noise)
    paths = [folder / "renders" / f"{name}.png"]
    write_sheet({scene.prompt: frames}, paths[0])
    for number, frame in enumerate(frames):
        paths.append(folder / "renders" / f"{name}_{number:02d}.png")
        write_picture(paths[-1], Image.fromarray(frame))
    return paths
