"""Whether a folder is a pipeline in Stable Diffusion's layout, told from its configs and file headers alone."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from fd_mitsuba.errors import UserError, first_line, out_of_memory
from fd_mitsuba.guidance.model_conventions import FILE_NAME, ModelConventions
from fd_mitsuba.guidance.multiview import is_multiview

LAYOUT = (
    "only Stable Diffusion 1.x/2.x, inpainting, InstructPix2Pix and MVDream layouts work (UNet, one CLIP text encoder)"
)
LAYOUT_NAME = "Stable-Diffusion layout"
WEIGHTS = {
    "unet": "diffusion_pytorch_model",
    "vae": "diffusion_pytorch_model",
    "text_encoder": "model",
}
"""Components with weights, and the name of their file without its ending."""
TOKENIZER_FILES = (("tokenizer.json",), ("vocab.json", "merges.txt"))
CLASSES = {
    "unet": {"UNet2DConditionModel", "MultiViewUNetModel"},
    "vae": {"AutoencoderKL", "AutoencoderTiny"},
    "text_encoder": {"CLIPTextModel"},
    "tokenizer": {"CLIPTokenizer", "CLIPTokenizerFast", "PreTrainedTokenizerFast"},
    "scheduler": None,
}
_UNREAD = {"safety_checker", "feature_extractor", "image_encoder"}
"""Components that a pipeline may have and that take no part in what its UNet sees."""


def read_layout(folder: Path) -> dict[str, Any]:
    """`model_index.json` of a folder, after checking that it and its sub-folders have Stable Diffusion's layout."""
    path = folder / "model_index.json"
    if not path.is_file():
        raise UserError(f"{folder}: has no model_index.json, so it is not a Diffusers pipeline folder; {LAYOUT}")
    index = read_json(path)
    name = index.get("_class_name", "of an unknown class")
    if index.get("transformer") is not None:
        raise UserError(f"{path}: the pipeline {name} is built on a transformer; {LAYOUT}")
    if index.get("text_encoder_2") is not None:
        raise UserError(f"{path}: the pipeline {name} has two text encoders (SDXL); {LAYOUT}")
    for part, classes in CLASSES.items():
        entry = index.get(part)
        found = entry[1] if isinstance(entry, list) and len(entry) == 2 else None
        if not isinstance(found, str):
            raise UserError(f"{path}: the pipeline {name} has no {part}; {LAYOUT}")
        if classes is not None and found not in classes:
            raise UserError(f"{path}: {part} is a {found}, not a {' or '.join(sorted(classes))}; {LAYOUT}")
    for part, entry in index.items():
        if isinstance(entry, list) and entry and entry[0] is not None and part not in CLASSES.keys() | _UNREAD:
            raise UserError(f"{path}: the pipeline {name} has a {part} besides, which would be left out; {LAYOUT}")
    needed = [f"{part}/config.json" for part in WEIGHTS] + ["scheduler/scheduler_config.json", "tokenizer"]
    for name in needed:
        if not (folder / name).exists():
            raise UserError(f"{folder / name}: missing from the pipeline folder; copy or fetch the whole model again")
    tokenizer = folder / "tokenizer"
    # Without these files transformers makes an empty tokenizer and says nothing.
    if not any(all((tokenizer / name).is_file() for name in names) for names in TOKENIZER_FILES):
        raise UserError(f"{tokenizer}: has neither tokenizer.json nor vocab.json and merges.txt; fetch the model again")
    return index


def weight_files(folder: Path, part: str, stem: str | None = None) -> tuple[list[Path], str | None]:
    """The safetensors files of a component and their variant (None, or `fp16` where only that is there).

    Pickled weights (`.bin`, `.ckpt`) are refused: loading them runs whatever code they hold.
    """
    stem = stem or WEIGHTS[part]
    for variant in (None, "fp16"):
        name = f"{stem}.safetensors" if variant is None else f"{stem}.{variant}.safetensors"
        listing = f"{stem}.safetensors.index.json" if variant is None else f"{stem}.safetensors.index.{variant}.json"
        if (folder / part / name).is_file():
            return [folder / part / name], variant
        if (folder / part / listing).is_file():
            shards = _shards(folder / part / listing)
            missing = [shard for shard in shards if not (folder / part / shard).is_file()]
            if missing:
                raise UserError(f"{folder / part / missing[0]}: missing from the pipeline folder; fetch it again")
            return [folder / part / shard for shard in shards], variant
    if any(path.suffix in (".bin", ".ckpt", ".pt") for path in (folder / part).iterdir()):
        raise UserError(
            f"{folder / part}: has pickled weights only, which can run code; convert them to {stem}.safetensors"
        )
    raise UserError(f"{folder / part / stem}.safetensors: missing from the pipeline folder; fetch the model again")


def _shards(listing: Path) -> list[str]:
    """The files that a component's weights are spread over."""
    places = read_json(listing).get("weight_map")
    if not isinstance(places, dict) or not places or not all(isinstance(name, str) for name in places.values()):
        raise UserError(f"{listing}: its weight_map does not say which file each tensor is in; fetch the file again")
    return sorted(set(places.values()))


def count_weights(path: Path) -> int:
    """Number of values in a safetensors file, read from its header alone.

    Raises:
        UserError: damaged or cut short (the header's offsets must cover the file).
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as tensors:
            return sum(torch.Size(tensors.get_slice(key).get_shape()).numel() for key in tensors.keys())  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, MemoryError) as error:
        if problem := out_of_memory(error):
            raise UserError(f"{path}: {problem}") from None
        raise UserError(f"{path}: damaged weights ({first_line(error)}); copy or fetch the file again") from None


def latent_side(unet_config: dict[str, Any]) -> int:
    """Side of the latents the UNet was trained at; a UNet that does not say is taken for 64. See `check_sizes`."""
    size = unet_config.get("sample_size") or 64
    return int(size if isinstance(size, int) else size[0])


def check_square(path: Path, config: dict[str, Any], key: str) -> None:
    """UserError where the side of a config's pictures is no whole number above 0, nor a pair of equal ones."""
    size = config.get(key) or 64
    sides = size if isinstance(size, list | tuple) else [size, size]
    if len(sides) != 2 or not all(_is_whole(side) for side in sides):
        raise UserError(f"{path}: {key} is {size!r}, not a whole number above 0; fetch the file again")
    if sides[0] != sides[1]:
        raise UserError(f"{path}: {key} {size} is not square; take a model with square pictures")


def _is_whole(value: Any, least: int = 1) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value < 1 << 31


def _check_counts(path: Path, config: dict[str, Any], key: str, least: int = 1) -> None:
    """UserError where a config's list of whole numbers, if it has it, is another thing."""
    counts = config.get(key)
    if counts is None:
        return
    if not isinstance(counts, list | tuple) or not counts or not all(_is_whole(count, least) for count in counts):
        raise UserError(f"{path}: {key} is {counts!r}, not a list of whole numbers; fetch the file again")


def _check_vae(path: Path, vae: dict[str, Any]) -> None:
    for key in ("block_out_channels", "encoder_block_out_channels"):
        _check_counts(path, vae, key)
    _check_counts(path, vae, "num_encoder_blocks", least=0)
    if not _is_whole(vae.get("layers_per_block", 2)):
        raise UserError(
            f"{path}: layers_per_block is {vae['layers_per_block']!r}, not a whole number above 0; fetch the file again"
        )
    for key, usual in (("scaling_factor", 1.0), ("shift_factor", 0.0)):
        value = usual if key == "shift_factor" and vae.get(key) is None else vae.get(key, usual)
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not number or (key == "scaling_factor" and value <= 0):
            wanted = "a number above 0" if key == "scaling_factor" else "a finite number"
            raise UserError(f"{path}: {key} is {value!r}, not {wanted}; fetch the file again")


def check_scheduler(folder: Path, unet: dict[str, Any], conventions: ModelConventions) -> None:
    """UserError where a pipeline's schedule has not two timesteps, between which noise is drawn, or where what its UNet
    says of a noisy picture is not known.
    """
    path = folder / "scheduler" / "scheduler_config.json"
    schedule = read_json(path)
    count, predicted = schedule.get("num_train_timesteps", 1000), schedule.get("prediction_type", "epsilon")
    if not _is_whole(count, 2):
        raise UserError(f"{path}: num_train_timesteps is {count!r}, not a whole number above 1; fetch the file again")
    if predicted not in ("epsilon", "v_prediction", "sample"):
        raise UserError(
            f"{path}: prediction_type {predicted!r} is not known; take a model with epsilon or v_prediction"
        )
    sees_base = unet.get("in_channels", 4) == 8 or conventions.sees_region
    if conventions.predicts == "difference" and not (sees_base and predicted == "sample"):
        raise UserError(
            f"{folder / FILE_NAME}: predicts difference takes a UNet with 8 input channels, or 9 with sees_region, and "
            "prediction_type sample; remove the entry"
        )


def check_sizes(folder: Path, configs: dict[str, dict[str, Any]], conventions: ModelConventions) -> None:
    unet, vae, text = (configs[part] for part in ("unet", "vae", "text_encoder"))
    path = folder / "unet" / "config.json"
    channels, latent = unet.get("in_channels", 4), vae.get("latent_channels", 4)
    if channels not in (4, 8, 9):
        raise UserError(
            f"{path}: in_channels is {channels}; take a model with 4, 8 (InstructPix2Pix) or 9 (inpainting)"
        )
    if latent != 4 or unet.get("out_channels", 4) != 4:
        raise UserError(f"{path}: UNet and VAE must share 4 latent channels; take a Stable Diffusion 1.x/2.x model")
    if conventions.sees_region and channels != 9:
        raise UserError(
            f"{folder / FILE_NAME}: sees_region but the UNet has {channels} input channels, not 9; mend sees_region"
        )
    check_square(path, unet, "sample_size")
    _check_counts(path, unet, "block_out_channels")
    _check_vae(folder / "vae" / "config.json", vae)
    if unet.get("time_cond_proj_dim") is not None:
        raise UserError(
            f"{path}: time_cond_proj_dim = {unet['time_cond_proj_dim']!r}: a latent consistency model, which was "
            "distilled to jump to the end and tells no noise; take the model that it was made from"
        )
    for key in ("addition_embed_type", "class_embed_type", "encoder_hid_dim"):
        if unet.get(key) is not None and not (key == "class_embed_type" and is_multiview(unet)):
            raise UserError(f"{path}: {key} = {unet[key]!r} asks for a condition beside the text; {LAYOUT}")
    width, wanted = text.get("hidden_size", 512), unet.get("cross_attention_dim", 1280)
    if width != wanted:
        raise UserError(
            f"{path}: cross_attention_dim {wanted} does not fit the text encoder's hidden_size {width}; {LAYOUT}"
        )
    if latent_side(unet) % conventions.view_grid:
        raise UserError(
            f"{folder / FILE_NAME}: view_grid {conventions.view_grid} does not divide the latents' side "
            f"{latent_side(unet)}; mend view_grid"
        )
    if conventions.needs_base is not None and conventions.needs_base != (channels != 4):
        raise UserError(
            f"{folder / FILE_NAME}: needs_base is {conventions.needs_base} but the UNet has {channels} input "
            "channels; mend needs_base"
        )


def read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: not readable JSON ({first_line(error)}); copy or fetch the file again") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: must hold a JSON object; copy or fetch the file again")
    return data
