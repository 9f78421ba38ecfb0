"""A rough forecast of what a run will cost, before anyone waits for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.backend.speed import processor_speed
from fd_mitsuba.backend.threads import cores_in_use
from fd_mitsuba.config import GuidanceConfig, RunConfig
from fd_mitsuba.config.for_model import is_builtin, is_small_prior
from fd_mitsuba.conventions import GRID_HALF_EXTENT, STAGES
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.drafter import STEPS as DDIM_STEPS
from fd_mitsuba.guidance.interface import Phase
from fd_mitsuba.guidance.network_passes import network_passes
from fd_mitsuba.runs.cost_memory import memory_warning, run_memory
from fd_mitsuba.runs.network_size import network_size
from fd_mitsuba.runs.scene_size import SceneSize
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import union_sdf

START_AND_EXPORT_SECONDS = 20.0
"""What every run takes besides its steps: imports, meshes, turntable, report. A first run compiles as long again."""

LIT_PICTURES_SECONDS = 12.0
"""What the appearance stage takes besides its steps and photographs: lit turntable, baked textures."""

PHOTOGRAPHS_SECONDS = 11.0
"""Of `output.picture_size` = 768; half of it is for what has a size of its own."""

_GFLOPS = 104.0
"""Of one core of the machine that all these seconds are of; see `processor_speed`."""

_OPERATIONS_ELSEWHERE = {"float32": 3e13, "bfloat16": 6e13, "float16": 6e13}
"""Floating-point operations a second of a graphics card that is not here: they differ by a factor of ten and more."""
_MOST_CORES_OF_USE = 16
_CONTROLNET = 0.42
"""Weights of a ControlNet over those of its UNet: 361 and 860 million for Stable Diffusion 1.5."""

_SECONDS_PER_MILLION_FACES = 20.0
"""In each stage: search trees, signs of the grid, meshes to write."""
_SECONDS_PER_MILLION_LIGHT_PIXELS = 0.5
_SECONDS_PER_MILLION_TEXELS = 3.5
_USUAL_TEXELS = 512**2
"""Of a baked texture; so many are in the seconds above."""

_REACH = 0.15
"""How far around its regions a part is evaluated: that of `extraction.surface`, without its imports."""


@dataclass(frozen=True)
class CostEstimate:
    """A rough forecast: within a factor of two on a machine like the one of the assumptions."""

    active_vertices: int
    active_share: float
    seconds_per_step: float
    seconds_total: float
    geometry_memory_mb: float
    """These are of the geometry stage."""
    appearance_seconds_per_step: float
    appearance_seconds_total: float
    """0 where the stage is left out."""
    memory_mb: float
    """At the peak of the whole run, all stages and exports, in units of 2^20 bytes, to about 15 %."""
    memory_warning: str
    """What to say where this machine has hardly so much left; else nothing."""
    assumptions: tuple[str, ...]


def estimate_cost(scene: EditScene, config: RunConfig) -> CostEstimate:
    """A rough forecast of a run's time, by counting what a step touches, and of its memory: see `cost_memory`.

        step = fixed + field (active vertices) + surface (faces) + rays + guidance (passes of the networks)

    averaged over the phases: a refined step renders eight times as many pixels a side and, with Stable Diffusion, sends
    them through the VAE's encoder and back. The constants are fitted to runs of the pegasus scene with 2 cores of
    104 GFLOP/s, no GPU: 0.125 s a step of `configs/quick.toml`, 0.178 s on the grid of 128 cells a side, 0.297 s in the
    refined phase; all else of a geometry run took 18 s. All of them are scaled by how fast this machine's core is at
    this moment.
    """
    geometry, guidance = config.geometry, config.guidance
    axis = np.linspace(-GRID_HALF_EXTENT, GRID_HALF_EXTENT, 41)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    share = float(np.mean(union_sdf(scene.regions, lattice) > -_REACH))
    vertices = (geometry.grid_resolution + 1) ** 3
    active = round(share * vertices)

    queries = active + geometry.focal_samples
    field = 3.5e-8 * config.field.levels * queries
    surface = 4e-7 * 8.6 * vertices ** (2 / 3)
    builtin = is_builtin(guidance.model)
    cores = min(cores_in_use(), _MOST_CORES_OF_USE)
    network = network_size(guidance.model)
    side, weights = (32 if builtin else network.latent_size), network.weights
    refined = 1 - geometry.coarse_fraction
    coarse_rays = 3e-7 * geometry.views * side**2 * (geometry.spp + geometry.silhouette_spp)
    refined_rays = 3e-7 * geometry.views * (8 * side) ** 2 * (1 + geometry.silhouette_spp)
    slower = _GFLOPS * 1e9 / processor_speed()
    guided = geometry.lambda_sds > 0 or config.appearance.lambda_sds > 0
    speed = None if builtin or not guided else _speed(guidance)
    passes = (1 - refined) * _coarse_passes(scene, config) + refined * _passes(scene, config, "refined")
    if speed is None:
        forward = 0.0082 * slower * (0.75 + 0.5 / cores)  # four views are one picture to it; measured with two cores
        encoder = forward
    else:
        # Stable Diffusion's layout: 800 operations a weight at a 64x64 latent, 2.2e12 to encode a picture and back.
        forward, encoder = (side / 64) ** 2 * 800.0 * weights / speed.unet, (side / 64) ** 2 * 2.2e12 / speed.vae
    rays = slower * ((1 - refined) * coarse_rays + refined * refined_rays)
    image = passes * forward + rays + refined * geometry.views * encoder
    step = slower * (0.03 + field + surface) + (image if geometry.lambda_sds > 0 else 0.0)
    size = SceneSize.of(scene)
    more_faces, more_light = size.faces / 1e6, size.light_pixels / 1e6
    processor = f"{cores} core{'' if cores == 1 else 's'} of {processor_speed() / 1e9:.3g} GFLOP/s"
    assumptions = (
        f"{processor}, otherwise idle, views at the size of the latent",
        "that Mitsuba's kernels are in its cache: a first run compiles them, some 20 s more",
        *([] if speed is None else [speed.text]),
        f"a base of {size.faces} faces, light of {more_light:.3g} million pixels",
        f"a UNet of {weights / 1e6:.3g} million weights ({network.source})",
        f"{queries} queries of the part's field a step",
    )
    # The run leaves the appearance stage out where its prior knows no faces of a cut.
    left_out = builtin and scene.subtracts and config.appearance.lambda_sds > 0
    stages = ("geometry",) if left_out else STAGES
    shape_memory = sum(run_memory(size, config, ("geometry",), network).values())
    terms = run_memory(size, config, stages, network)
    try:
        warning = memory_warning(scene, terms) or ""
    except UserError as error:
        warning = str(error)
    once = START_AND_EXPORT_SECONDS + _SECONDS_PER_MILLION_FACES * more_faces
    total = step * geometry.steps + slower * once
    lit = _appearance_step(scene, config, forward, encoder, slower)
    once = LIT_PICTURES_SECONDS + _photographs(config.output.picture_size)
    once += _SECONDS_PER_MILLION_FACES * more_faces + _SECONDS_PER_MILLION_LIGHT_PIXELS * more_light
    once += _SECONDS_PER_MILLION_TEXELS * max(config.output.texture_size**2 - _USUAL_TEXELS, 0) / 1e6
    lit_total = lit * config.appearance.steps + slower * once
    if left_out:
        lit = lit_total = 0.0
    return CostEstimate(
        active, share, step, total, shape_memory, lit, lit_total, sum(terms.values()), warning, assumptions
    )


def _photographs(size: int) -> float:
    return PHOTOGRAPHS_SECONDS * (0.5 + 0.5 * (size / 768) ** 2) if size else 0.0


@dataclass(frozen=True)
class _Speed:
    """Floating-point operations a second of the UNet and of the VAE, and how they are known."""

    unet: float
    vae: float
    text: str


def _speed(guidance: GuidanceConfig) -> _Speed:
    """Measured where the device is there; the VAE is always float32."""
    from fd_mitsuba.guidance.speed import measured_speed

    device, dtype = guidance.device, guidance.dtype
    unet = measured_speed(device, dtype)
    vae = unet if dtype == "float32" else measured_speed(device, "float32")
    how = "as measured just now"
    if unet is None or vae is None:
        unet, vae = _OPERATIONS_ELSEWHERE[dtype], _OPERATIONS_ELSEWHERE["float32"]
        how = f"as of a usual card: torch finds no {device} here"
    rates = " and ".join(
        dict.fromkeys(f"{rate / 1e12:.3g} TFLOP/s in {kind}" for rate, kind in ((unet, dtype), (vae, "float32")))
    )
    return _Speed(unet, vae, f"networks on {device} at {rates}, {how}")


def _passes(scene: EditScene, config: RunConfig, phase: Phase) -> float:
    """Passes of the network in a step of a phase, for all its views."""
    guidance, lit = config.guidance, phase == "appearance"
    negatives = [text.negative_prompt for text in scene.part_prompts.values()]
    views = (config.appearance if lit else config.geometry).views
    with_image = network_size(guidance.model, lit).has_image_pass
    return views * network_passes(
        phase, guidance, config.appearance, with_image, views, scene.negative_prompt, negatives
    )


def _coarse_passes(scene: EditScene, config: RunConfig) -> float:
    """The same on average over the coarse phase: its drafted steps ask for none, but what they follow is drawn once."""
    geometry, passes = config.geometry, _passes(scene, config, "coarse")
    model, steps = config.guidance.model, geometry.steps * geometry.coarse_fraction
    if scene.subtracts or not steps or not is_small_prior(model) or not network_size(model).has_image_pass:
        return passes
    drawing = geometry.views * 2 * DDIM_STEPS if geometry.draft_fraction else 0
    return (1 - geometry.draft_fraction) * passes + drawing / steps


def _appearance_step(scene: EditScene, config: RunConfig, forward: float, encoder: float, slower: float) -> float:
    """Seconds of a step of the appearance stage: fixed + light samples + passes of the networks.

    Fitted to `benchmarks/appearance_step.py` (0.19 s for 4 views of 128 x 128 pixels and 16 samples) and to runs of
    `configs/quick.toml` (0.095 s). Each bounce beyond the first costs about half of that light.

    Args:
        forward, encoder: seconds for a view through the UNet, and through the VAE's encoder and back.
        slower: seconds of this machine over those of the one that the constants are of.
    """
    settings = config.appearance
    builtin = is_builtin(config.guidance.model)
    guided = settings.lambda_sds > 0
    side = settings.picture_size or (
        (32 if builtin else 8 * network_size(config.guidance.model).latent_size) if guided else 128
    )
    samples = settings.views * side**2 * settings.spp
    depth = settings.max_depth if settings.max_depth > 0 else 8
    light = slower * 1.3e-7 * samples * (1 + 0.5 * (depth - 2))
    passes = _passes(scene, config, "appearance")
    if config.guidance.controlnet:
        passes *= 1 + _CONTROLNET
    # A prior in pixels needs no encoder; it is shown the part in clay as well.
    image = passes * forward + (0.3 * light if builtin else settings.views * encoder)
    return slower * (0.05 + (0.03 if settings.style else 0.0)) + light + (image if guided else 0.0)
