"""ControlNet on top of a model: a copy of the UNet's first half that is shown the surface and steers the rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.layout import count_weights, read_json, weight_files
from fd_mitsuba.io.hub import hub_snapshot, local_folder

_STEM = "diffusion_pytorch_model"
_SHARED = ("cross_attention_dim", "block_out_channels", "down_block_types")
"""What a ControlNet has in common with the UNet that it was made for."""


def local_controlnet(model: str) -> Path | None:
    """The folder that `guidance.controlnet` is; None where it is a hub id."""
    return local_folder(model, "guidance.controlnet", "a ControlNet's layout")


def locate_controlnet(model: str) -> Path:
    """The folder of `guidance.controlnet`: itself, or a snapshot of a hub id."""
    return local_controlnet(model) or hub_snapshot(model, ["config.json", f"{_STEM}*.safetensors*"], ["*.fp16.*"])


def check_controlnet(folder: Path, unet: dict[str, Any]) -> tuple[int, str | None]:
    """Its number of weights, and the variant of its files, after checking that it fits the UNet's config.

    Raises:
        UserError: a whole pipeline, no ControlNet, one for another UNet, or one that is shown something else than a
            picture.
    """
    if (folder / "model_index.json").is_file():
        raise UserError(f"{folder}: is a whole pipeline; set guidance.controlnet to the folder {folder / 'controlnet'}")
    path = folder / "config.json"
    if not path.is_file():
        raise UserError(f"{path}: missing, so this is no ControlNet; give a folder that Diffusers saved")
    config = read_json(path)
    if config.get("_class_name") != "ControlNetModel":
        raise UserError(
            f"{path}: is a {config.get('_class_name')}, not a ControlNetModel; take one for Stable Diffusion"
        )
    for key in _SHARED:
        if config.get(key) != unet.get(key):
            raise UserError(
                f"{path}: {key} is {config.get(key)}, the model's UNet has {unet.get(key)}; take a ControlNet that was "
                "made for the model of guidance.model"
            )
    channels = config.get("in_channels", 4), config.get("conditioning_channels", 3)
    if channels != (4, 3):
        raise UserError(f"{path}: takes {channels[0]} and {channels[1]} channels, not 4 of latents and 3 of a picture")
    files, variant = weight_files(folder.parent, folder.name, _STEM)
    return sum(map(count_weights, files)), variant
