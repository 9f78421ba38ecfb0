"""How much memory a run will take at its peak: what a run takes in any case, and what each input adds.

The numbers are differences of measured peaks (resident set, 2 cores, `configs/quick.toml`, the cat): 1.80 GB as it is
shipped; 2.34 GB with 1.1 million faces, 2.80 with 1.6 and 3.54 with 2.0, 1.84 GB with 1.3 million around the base, 5.3
to 6.5 GB under a light of 8192 x 4096 pixels, 3.24 GB with textures of 4096 x 4096, 4.31 GB with baked textures of that
size, 1.82 GB on a grid of 128 cells a side.
"""

from __future__ import annotations

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.bounds import MOST_SAMPLES
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.config.sections import FieldConfig, OutputConfig, TextureConfig
from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.memory import BYTES, available_bytes, critic_bytes, held_bytes
from fd_mitsuba.guidance.network_passes import rows_at_once
from fd_mitsuba.guidance.variants import critic_rank
from fd_mitsuba.render.geometry_pass import RAYS_AT_ONCE
from fd_mitsuba.runs.network_size import NetworkSize
from fd_mitsuba.runs.scene_size import SceneSize
from fd_mitsuba.scene.edit_scene import EditScene

_MIB = 2.0**20
_IMPORTS, _BUILTIN = 390.0, 200.0
_SHAPE, _MATERIAL = 390.0, 370.0
"""What the geometry stage with its exports, and then the appearance stage with its own, add in any case."""
_PER_FACE = {"check": 830.0, "run": 740.0}
_PER_FACE_AROUND = 160.0
_PER_LIGHT_PIXEL = {"check": 70.0, "run": 125.0}
_PER_HELD_LIGHT_PIXEL = 41.0
_PER_TEXTURE_VALUE = {"check": 3.0, "run": 29.0}
_PER_GRID_VERTEX = 165.0
_PER_TEXEL = 178.0
_PER_TABLE_BYTE = 10.0
"""A field's parameters, their gradients and moments, and the copies of a checkpoint."""
_PER_PHOTOGRAPHED_PIXEL = 250.0
_PER_SAMPLE, _PER_RAY, _PER_FRAME_PIXEL = 59.0, 85.0, 30.0
_USUAL_FRAME_PIXELS = 48 * 256**2
_USUAL_GRID, _USUAL_SAMPLES, _USUAL_TEXELS = 65**3, 1 << 21, 1024**2
_TIGHT, _TOO_MUCH = 0.9, 1.25
"""Shares of what is left from which a run is warned of, and refused: the forecast is right to about 15 %."""
_WORTH_NAMING = 0.25


def check_memory_mb(size: SceneSize) -> float:
    """Peak of `fd_mitsuba check` in units of 2^20 bytes."""
    return _IMPORTS + 20 + sum(_scene_terms(size, "check").values())


def run_memory(size: SceneSize, config: RunConfig, stages: tuple[str, ...], network: NetworkSize) -> dict[str, float]:
    """Setting or input -> what it adds to the peak of a run, in units of 2^20 bytes; "any run" is the rest.

    Args:
        stages: `geometry`, `appearance` or both.
        network: the guidance model's UNet.
    """
    lit = "appearance" in stages
    terms = {"any run": _IMPORTS + _SHAPE + (_MATERIAL if lit else 0.0)}
    terms |= _scene_terms(size, "run" if lit else "check")
    if not lit:  # a large light takes most while it is read, when the rest of the run is not there yet
        light = size.light_pixels / _MIB
        terms["light"] = max(_PER_HELD_LIGHT_PIXEL * light, terms["light"] - _SHAPE - _ring(config.output))
    grid = (config.geometry.grid_resolution + 1) ** 3
    terms["geometry.grid_resolution"] = _PER_GRID_VERTEX * (grid - _USUAL_GRID) / _MIB
    terms["field.log2_table"] = _PER_TABLE_BYTE * _table_bytes(config.field) / _MIB
    terms["guidance.model"] = _guidance(config, stages, network)
    terms["output.turntable_size"] = _ring(config.output)
    if lit:
        settings, output = config.appearance, config.output
        side = settings.picture_size or (32 if is_builtin(config.guidance.model) else 8 * network.latent_size)
        step = settings.views * side**2 * settings.spp
        photograph = max(_USUAL_SAMPLES, output.picture_size**2)
        name = "output.picture_size" if photograph >= step else "appearance.spp"
        terms[name] = _PER_SAMPLE * (max(photograph, step) - _USUAL_SAMPLES) / _MIB
        terms["photographs"] = _PER_PHOTOGRAPHED_PIXEL * output.picture_size**2 / _MIB
        terms["output.texture_size"] = _PER_TEXEL * (output.texture_size**2 - _USUAL_TEXELS) / _MIB
        terms["texture.log2_table"] = _PER_TABLE_BYTE * _table_bytes(config.texture) / _MIB
    return terms


def memory_warning(scene: EditScene, terms: dict[str, float]) -> str | None:
    """What to say where a run of `run_memory`'s terms will hardly fit into what this machine has left.

    Raises:
        UserError: it will not fit.
    """
    needed, left = sum(terms.values()) * _MIB - held_bytes(), available_bytes()
    if left is None or needed <= _TIGHT * left:
        return None
    largest = max((name for name in terms if name != "any run"), key=lambda name: terms[name])
    share = terms[largest] * _MIB
    text = (
        f"{scene.path}: the run needs about {needed / 1e9:.1f} GB of memory at its peak, and {left / 1e9:.1f} GB are "
        "left; free some"
    )
    if share > _WORTH_NAMING * needed:
        cause, remedy = _CAUSES.get(largest, largest), _REMEDIES.get(largest, "lower it")
        text += f", or {remedy}: {share / 1e9:.1f} GB are for {cause}"
    if needed > _TOO_MUCH * left:
        raise UserError(text)
    return text


def refuse_too_many_samples(pictures: int, size: int, spp: int, options: str) -> None:
    """UserError where so many square pictures of so many samples a pixel cannot be rendered at once.

    Args:
        options: what the user gave, for the message.
    """
    samples = pictures * size**2 * spp
    needed, left = _PER_SAMPLE * samples, available_bytes()
    if samples > MOST_SAMPLES or (left is not None and needed > _TOO_MUCH * left):
        much = "more than Dr.Jit can number" if samples > MOST_SAMPLES else f"{needed / 1e9:.1f} GB of memory"
        raise UserError(f"{options}: {pictures} pictures at once are {samples} samples, {much}; lower size or samples")


_CAUSES = {
    "faces": f"the faces of the {BASE_NAME}",
    "surroundings": "the faces around it",
    "light": "the light's image",
    "textures": "the scene's textures",
}
_REMEDIES = {
    "faces": "take a mesh with fewer",
    "surroundings": "take meshes with fewer",
    "light": "take a smaller one",
    "textures": "take smaller ones",
    "guidance.model": "lower guidance.views_per_call or take a smaller model",
}


def _scene_terms(size: SceneSize, command: str) -> dict[str, float]:
    return {
        "faces": _PER_FACE[command] * size.faces / _MIB,
        "surroundings": _PER_FACE_AROUND * size.faces_around / _MIB,
        "light": _PER_LIGHT_PIXEL[command] * size.light_pixels / _MIB,
        "textures": _PER_TEXTURE_VALUE[command] * size.texture_values / _MIB,
    }


def _ring(output: OutputConfig) -> float:
    """The turntable of the shape: a portion of its rays, and all of its frames."""
    pixels = output.turntable_frames * output.turntable_size**2
    sheet = 8 * min(output.turntable_size, 192) ** 2
    portion = min(RAYS_AT_ONCE, 9 * max(pixels, sheet))
    return (_PER_RAY * portion + _PER_FRAME_PIXEL * (pixels - _USUAL_FRAME_PIXELS)) / _MIB


def _guidance(config: RunConfig, stages: tuple[str, ...], network: NetworkSize) -> float:
    guidance, weights, latent_size = config.guidance, network.weights, network.latent_size
    wanted = [config.geometry.lambda_sds > 0] * ("geometry" in stages)
    wanted += [config.appearance.lambda_sds > 0] * ("appearance" in stages)
    if not any(wanted):
        return 0.0
    if is_builtin(guidance.model):
        return _BUILTIN
    size = BYTES[guidance.dtype]
    if guidance.controlnet:
        weights *= 1.42  # it has 361 million beside the 860 of Stable Diffusion 1.5
    text = 4 * 123e6  # the text encoder stays on the CPU, and so does its float32
    if guidance.device != "cpu":
        return (text + weights * size) / _MIB  # loaded here before it is moved
    # As `guidance.memory` demands: weights with the VAE, one call of the UNet, the encoder's maps for half of it.
    calls = 65e6 * size * guidance.views_per_call + 3300e6 * max(1, guidance.views_per_call // 2)
    taught = rows_at_once(guidance.views_per_call, 2)
    critic = critic_bytes({}, latent_size, taught, guidance.dtype, critic_rank(guidance))
    return (text + weights * size + 4 * 84e6 + (latent_size / 64) ** 2 * calls + critic) / _MIB


def _table_bytes(field: FieldConfig | TextureConfig) -> float:
    """Bytes of a hash grid's parameters, levels that are smaller than the table counted as they are."""
    levels, features, table = field.levels, field.features, 2**field.log2_table
    growth = (field.finest_resolution / field.base_resolution) ** (1 / max(levels - 1, 1))
    sides = (field.base_resolution * growth**level for level in range(levels))
    return sum(4.0 * features * min(table, (side + 1) ** 3) for side in sides)
