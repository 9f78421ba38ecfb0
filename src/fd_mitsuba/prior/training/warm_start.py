"""Start a prior from the weights of another one, so that it knows at once what that one knows.

A UNet of pictures twice as wide (`grow`) has one level more, above the others: level k of the smaller becomes level
k + 1 of the larger, which sees as many cells. The new level passes its input down and what comes back up, and learns
detail from there.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
from diffusers import UNet2DConditionModel
from safetensors.torch import load_file
from torch import Tensor
from transformers import PreTrainedTokenizerFast

from fd_mitsuba.errors import UserError
from fd_mitsuba.prior.training.model import load_packed

_DOWN_BLOCK = re.compile(r"^down_blocks\.(\d+)\.")


def load_start(
    packed: Path, modules: torch.nn.ModuleDict, tokenizer: PreTrainedTokenizerFast, prediction_type: str
) -> None:
    """Load a packed prior into `modules`: one of as large pictures, or of pictures half as large.

    Raises:
        UserError: its UNet cannot be a start of this one.
    """
    unet: Any = modules["unet"]
    small: Any = UNet2DConditionModel.from_pretrained(str(packed / "unet"), local_files_only=True)
    levels, own_levels = tuple(small.config.block_out_channels), tuple(unet.config.block_out_channels)
    same, deeper = own_levels == levels, own_levels == (levels[0], *levels)
    if not (same or deeper) or small.config.in_channels != unet.config.in_channels:
        raise UserError(
            f"{packed}: its UNet has levels of {levels} channels and {small.config.in_channels} inputs, which cannot "
            f"start one of {own_levels} and {unet.config.in_channels}; leave --init out"
        )
    load_packed(packed, modules, tokenizer, prediction_type, with_unet=same)
    if deeper:
        grow(unet, load_file(packed / "unet" / "diffusion_pytorch_model.safetensors"))


@torch.no_grad()
def grow(unet: UNet2DConditionModel, small: dict[str, Tensor]) -> None:
    """Put the weights `small` of a UNet one level deeper into `unet`, whose two finest levels are as wide."""
    target = unet.state_dict()
    for name, value in small.items():
        own = _DOWN_BLOCK.sub(lambda match: f"down_blocks.{int(match[1]) + 1}.", name)
        if not own.startswith("conv_in."):
            target[own].copy_(value)
    # The new level: in, the picture as it is and what may be learnt beside it; then the smaller network's first layer.
    inputs = target["conv_in.weight"].shape[1]
    _hand_over(target, "conv_in", inputs)
    down = target["down_blocks.0.downsamplers.0.conv.weight"]
    down.zero_()
    down[:, :inputs].copy_(small["conv_in.weight"])
    target["down_blocks.0.downsamplers.0.conv.bias"].copy_(small["conv_in.bias"])
    _silence(target, "down_blocks.0.resnets.0.conv2")
    # Out: what the smaller network would hand to its last layer, twice as large, and corrections that start at zero.
    last = len(unet.up_blocks) - 1
    _hand_over(target, f"up_blocks.{last - 1}.upsamplers.0.conv")
    for number in (0, 1):
        block = f"up_blocks.{last}.resnets.{number}"
        _silence(target, f"{block}.conv2")
        _hand_over(target, f"{block}.conv_shortcut")
    unet.load_state_dict(target)


def _silence(weights: dict[str, Tensor], layer: str, count: int | None = None) -> None:
    """Let a convolution's first `count` channels, or all, say nothing."""
    weights[f"{layer}.weight"][:count] = 0
    weights[f"{layer}.bias"][:count] = 0


def _hand_over(weights: dict[str, Tensor], layer: str, count: int | None = None) -> None:
    """Let a convolution hand its first `count` channels over, or as many as it has."""
    _silence(weights, layer, count)
    weight = weights[f"{layer}.weight"]
    middle = weight.shape[-1] // 2
    for channel in range(count or len(weight)):
        weight[channel, channel, middle, middle] = 1
