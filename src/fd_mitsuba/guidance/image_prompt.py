"""Image prompts: an IP-Adapter lets the UNet look at a picture beside the text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError, first_line
from fd_mitsuba.guidance.layout import read_json
from fd_mitsuba.guidance.lora import lora_file, refuse_non_finite

_PLAIN = ("proj.weight", "proj.bias", "norm.weight", "norm.bias")
"""How a plain adapter turns a picture into words: a linear layer and a norm. "Plus" adapters have more."""
_SETTINGS = ("image_prompt", "ip_adapter", "ip_adapter_encoder")


def asks_for_image_prompt(config: GuidanceConfig) -> bool:
    """Whether a picture is given; UserError where one of the three settings is missing."""
    given = [name for name in _SETTINGS if getattr(config, name)]
    if given and len(given) < len(_SETTINGS):
        missing = next(name for name in _SETTINGS if name not in given)
        raise UserError(
            f"guidance.{missing}: is missing; guidance.image_prompt, ip_adapter, ip_adapter_encoder go together"
        )
    return bool(given)


@torch.no_grad()
def add_image_prompt(config: GuidanceConfig, parts: dict[str, Any]) -> Tensor:
    """Put the adapter into the UNet; returns what the image encoder says of the picture, (1, width).

    Args:
        parts: the pipeline's `vae`, `text_encoder`, `tokenizer`, `unet`, `scheduler`.

    Raises:
        UserError: a file that is missing or damaged, another kind of adapter, one for another model or image encoder.
    """
    import diffusers
    import transformers

    picture = _picture(Path(config.image_prompt).expanduser())
    encoder = _encoder(Path(config.ip_adapter_encoder).expanduser())
    file = lora_file(Path(config.ip_adapter).expanduser(), "guidance.ip_adapter")
    state = _checked(file, parts["unet"], encoder)
    side = encoder.config.image_size
    processor = transformers.CLIPImageProcessor(size=side, crop_size=side)
    kind: Any = diffusers.StableDiffusionPipeline  # its signature has no None for what may be left out
    pipeline = kind(
        **parts, safety_checker=None, feature_extractor=processor, image_encoder=encoder, requires_safety_checker=False
    )
    try:
        pipeline.load_ip_adapter(
            state, subfolder="", weight_name="", image_encoder_folder=None, low_cpu_mem_usage=False
        )
    except Exception as error:
        raise UserError(f"{file}: cannot be put into the model ({first_line(error)}); take one made for it") from None
    parts["unet"].requires_grad_(False).eval()
    return pipeline.encode_image(picture, "cpu", 1)[0].float()


def _picture(path: Path) -> Image.Image:
    try:
        with Image.open(path) as picture:
            return picture.convert("RGB")
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        problem = f"is no picture that can be read ({first_line(error)})"
        raise UserError(f"{path}: {problem}; correct guidance.image_prompt") from None


def _encoder(folder: Path) -> Any:
    import transformers

    if not (folder / "config.json").is_file():
        raise UserError(
            f"{folder}: has no config.json; give the adapter's image encoder as guidance.ip_adapter_encoder"
        )
    if "CLIPVisionModelWithProjection" not in (read_json(folder / "config.json").get("architectures") or []):
        raise UserError(f"{folder}: is no CLIPVisionModelWithProjection; give the image encoder of the adapter")
    try:
        encoder = transformers.CLIPVisionModelWithProjection.from_pretrained(
            str(folder), use_safetensors=True, local_files_only=True, dtype=torch.float32
        )
    except Exception as error:
        raise UserError(f"{folder}: cannot be loaded ({first_line(error)}); fetch the image encoder again") from None
    return encoder.requires_grad_(False).eval()


def _checked(file: Path, unet: Any, encoder: Any) -> dict[str, dict[str, Tensor]]:
    """The adapter's tensors as diffusers takes them."""
    from safetensors import SafetensorError, safe_open

    state: dict[str, dict[str, Tensor]] = {"image_proj": {}, "ip_adapter": {}}
    try:
        with safe_open(file, framework="pt") as tensors:
            for key in tensors.keys():  # noqa: SIM118
                group, _, name = key.partition(".")
                if group in state:
                    state[group][name] = tensors.get_tensor(key)
                    refuse_non_finite(file, key, state[group][name])
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file}: damaged ({first_line(error)}); fetch the file again") from None
    if sorted(state["image_proj"]) != sorted(_PLAIN):
        raise UserError(
            f"{file}: is no plain IP-Adapter (plus, full and face adapters are not read); take another file"
        )
    norm, projection = state["image_proj"]["norm.weight"], state["image_proj"]["proj.weight"]
    if norm.ndim != 1 or projection.ndim != 2:
        raise UserError(
            f"{file}: image_proj.norm.weight {tuple(norm.shape)} and proj.weight {tuple(projection.shape)} are no "
            "vector and no matrix; fetch the file again"
        )
    width, seen = norm.shape[0], projection.shape[1]
    if width != unet.config.cross_attention_dim:
        raise UserError(
            f"{file}: its words have {width} numbers, the model's {unet.config.cross_attention_dim}; take an adapter "
            "for the model that guidance.model names"
        )
    if seen != encoder.config.projection_dim:
        raise UserError(
            f"{file}: reads {seen} numbers of a picture, the image encoder gives {encoder.config.projection_dim}; give "
            "the encoder that the adapter was made with"
        )
    return state
