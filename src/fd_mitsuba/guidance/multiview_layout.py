"""A multi-view model's folder: its UNet's config in Diffusers' terms, its weights under Diffusers' names, its limits.

MVDream's UNet is published in two layouts: as the class `MultiViewUNetModel` with the names of the original latent
diffusion code, and (what this package makes of it) as Diffusers' own `UNet2DConditionModel`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.layout import check_square
from fd_mitsuba.guidance.model_conventions import FILE_NAME, ModelConventions
from fd_mitsuba.guidance.multiview import CAMERA_NUMBERS, TEMPLATE, USUAL_GROUP, is_multiview

ORIGINAL_CLASS = "MultiViewUNetModel"
_NEEDED = ("model_channels", "num_res_blocks", "channel_mult", "attention_resolutions", "context_dim")
_PLAIN: dict[str, Any] = {
    "dims": 2,
    "num_classes": None,
    "use_scale_shift_norm": False,
    "resblock_updown": False,
    "conv_resample": True,
    "transformer_depth": 1,
    "n_embed": None,
    "num_attention_blocks": None,
}
"""Entries that would change the network, and the only value that has a place in Diffusers' UNet."""
_RENAMED = {"camera_embed.0.": "label_emb.0.0.", "camera_embed.2.": "label_emb.0.2."}
"""To the names under which Diffusers' converter looks for what is added to the timestep's embedding."""


def unet_config(path: Path, config: dict[str, Any]) -> dict[str, Any]:
    """The config of `unet/config.json` in Diffusers' terms; one that is so already stays as it is.

    Raises:
        UserError: an original config with an entry missing, or one that asks for more than Diffusers' UNet has.
    """
    if config.get("_class_name") != ORIGINAL_CLASS:
        return config
    if config.get("ip_dim"):
        raise UserError(
            f"{path}: ip_dim = {config['ip_dim']}: is made to be shown a picture (ImageDream); take a model that is "
            "guided by text, as MVDream"
        )
    if config.get("camera_dim") != CAMERA_NUMBERS:
        raise UserError(
            f"{path}: camera_dim is {config.get('camera_dim')}; take a model that is told its cameras by "
            f"{CAMERA_NUMBERS} numbers, as MVDream"
        )
    for key in _NEEDED:
        if config.get(key) is None:
            raise UserError(f"{path}: has no {key}; fetch the model again")
    for key, value in _PLAIN.items():
        if config.get(key, value) != value:
            raise UserError(f"{path}: {key} = {config[key]!r} has no place in Diffusers' UNet; take MVDream's layout")
    check_square(path, config, "image_size")
    try:
        return _in_diffusers_terms(config)
    except (TypeError, ValueError, KeyError, ZeroDivisionError):
        raise UserError(f"{path}: entries are not those of a {ORIGINAL_CLASS}; fetch the model again") from None


def _in_diffusers_terms(config: dict[str, Any]) -> dict[str, Any]:
    widths = [int(config["model_channels"]) * int(factor) for factor in config["channel_mult"]]
    if min(widths) < 1:
        raise ValueError("model_channels")
    attends = [2**level in config["attention_resolutions"] for level in range(len(widths))]
    per_head, heads = config.get("num_head_channels", -1), config.get("num_heads", -1)
    if per_head == heads == -1:
        raise KeyError("num_heads")
    return {
        "_class_name": "UNet2DConditionModel",
        "sample_size": config.get("image_size", 32),
        "in_channels": config.get("in_channels", 4),
        "out_channels": config.get("out_channels", 4),
        "block_out_channels": widths,
        "layers_per_block": int(config["num_res_blocks"]),
        "down_block_types": ["CrossAttnDownBlock2D" if attend else "DownBlock2D" for attend in attends],
        "up_block_types": ["CrossAttnUpBlock2D" if attend else "UpBlock2D" for attend in reversed(attends)],
        # Diffusers means the number of heads by this name.
        "attention_head_dim": [heads if per_head == -1 else width // per_head for width in widths],
        "cross_attention_dim": config["context_dim"],
        "use_linear_projection": True,
        "class_embed_type": "projection",
        "projection_class_embeddings_input_dim": CAMERA_NUMBERS,
    }


def converted_unet(files: list[Path], config: dict[str, Any], dtype: torch.dtype) -> torch.nn.Module:
    """Diffusers' UNet with weights whose names are those of the original code; in evaluation mode, without gradients.

    Args:
        files: safetensors, together all weights.
        config: of `unet_config`.
        dtype: of the weights, whatever it is in the files.

    Raises:
        UserError: a tensor that is missing, or one too many. What the libraries raise on others goes through.
    """
    import diffusers
    from accelerate import init_empty_weights
    from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint
    from safetensors.torch import load_file

    original: dict[str, torch.Tensor] = {}
    for file in files:
        for name, tensor in load_file(file).items():
            for old, new in _RENAMED.items():
                name = new + name.removeprefix(old) if name.startswith(old) else name
            original[f"model.diffusion_model.{name}"] = tensor.to(dtype)
    kind: Any = diffusers.UNet2DConditionModel  # its config is made up while it loads
    with init_empty_weights():
        unet = kind.from_config(config)
    folder, wanted = files[0].parent, len(unet.state_dict())
    if len(original) != wanted:
        raise UserError(
            f"{folder}: the weights are {len(original)} tensors, the config asks for {wanted}; fetch the model again"
        )
    unet.load_state_dict(convert_ldm_unet_checkpoint(original, config), assign=True)
    return unet.requires_grad_(False).eval()


def multiview_conventions(
    folder: Path, unet: dict[str, Any], conventions: ModelConventions, config: GuidanceConfig
) -> ModelConventions:
    """The conventions with what is usual for multi-view models where their file does not say; others as they are.

    Raises:
        UserError: cameras together with what such a model cannot have, or settings that cut its groups of views.
    """
    path = folder / FILE_NAME
    if not is_multiview(unet):
        if conventions.views_together is not None:
            raise UserError(f"{path}: views_together is {conventions.views_together}, and the UNet is told no cameras")
        return conventions
    where = folder / "unet" / "config.json"
    if unet.get("class_embeddings_concat"):
        raise UserError(f"{where}: class_embeddings_concat: cameras are added to the timestep here; take another model")
    channels = unet.get("in_channels", 4)
    if channels != 4:
        raise UserError(f"{where}: is told cameras and has {channels} input channels; take a multi-view model with 4")
    if conventions.view_grid != 1:
        raise UserError(f"{path}: view_grid {conventions.view_grid}: multi-view models see no mosaics; mend view_grid")
    for setting in ("controlnet", "image_prompt"):
        if getattr(config, setting):
            raise UserError(
                f"guidance.{setting}: {folder} is a multi-view model, for which there is none; remove the setting"
            )
    together = conventions.views_together or USUAL_GROUP
    if config.views_per_call < together:
        raise UserError(
            f"guidance.views_per_call = {config.views_per_call}: {folder} sees {together} views at once; set it to "
            f"{together} or more"
        )
    usual: dict[str, Any] = {"views_together": together}
    if "prompt_template" not in conventions.model_fields_set:
        usual["prompt_template"] = TEMPLATE
    return conventions.model_copy(update=usual)
