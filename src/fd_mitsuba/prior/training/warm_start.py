"""Start a prior from the weights of a smaller one, so that it knows at once what that one knows.

Where only the first level is wider (`widen`), it holds each channel twice, so that group norms with one group see the
same mean and size; what reads them takes unequal shares of both, so that the copies part in training.

A UNet of pictures twice as wide (`grow`) has one level more, above the others: level k of the smaller becomes level
k + 1 of the larger, which sees as many cells. The new level passes its input down and what comes back up, and learns
detail from there. A level that is wider holds each channel several times.
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
from fd_mitsuba.prior.training.model import FIRST_LAYER, load_packed, with_region

_DOWN_BLOCK = re.compile(r"^down_blocks\.(\d+)\.")
_UNEVEN = 0.3


def load_start(
    packed: Path, modules: torch.nn.ModuleDict, tokenizer: PreTrainedTokenizerFast, prediction_type: str
) -> None:
    """Load a packed prior into `modules`: of the same kind, with a first level as wide or half as wide, or of pictures
    half as wide.

    Raises:
        UserError: its UNet cannot be a start of this one.
    """
    unet: Any = modules["unet"]
    small: Any = UNet2DConditionModel.from_pretrained(str(packed / "unet"), local_files_only=True)
    levels, own_levels = tuple(small.config.block_out_channels), tuple(unet.config.block_out_channels)
    deeper = len(own_levels) - len(levels)
    load_packed(packed, modules, tokenizer, prediction_type, with_unet=own_levels == levels)
    if own_levels == levels:
        return
    if own_levels == (2 * levels[0], *levels[1:]):
        widen(unet, levels[0], load_file(packed / "unet" / "diffusion_pytorch_model.safetensors"))
        return
    if deeper != 1 or own_levels[2:] != levels[1:] or own_levels[0] != levels[0]:
        raise UserError(
            f"{packed}: its UNet has levels of {levels} channels, which cannot start one of "
            f"{own_levels}; leave --init out"
        )
    grow(unet, levels[0], load_file(packed / "unet" / "diffusion_pytorch_model.safetensors"))


@torch.no_grad()
def widen(unet: UNet2DConditionModel, width: int, small: dict[str, Tensor]) -> None:
    """Put the weights `small` of a UNet with a first level of `width` channels into one with twice as many there.

    The answer is the same but for the norms over that level and another one together, in which it counts twice.
    """
    target, generator = unet.state_dict(), torch.Generator().manual_seed(0)
    for name, value in small.items():
        into = target[name]
        if name == FIRST_LAYER:
            value = with_region(value, into.shape[1])
        if name.startswith("time_embedding.") or ".time_emb_proj." in name:
            _place_times(name, value, into, width)
        else:
            for axis in range(min(value.ndim, 2)):
                if value.shape[axis] != into.shape[axis]:
                    value = _doubled(value, axis, width, generator)
            into.copy_(value)
    unet.load_state_dict(target)


def _doubled(value: Tensor, axis: int, width: int, generator: torch.Generator) -> Tensor:
    """The first level's channels twice: all, both halves of the last block's, or the last ones that skip."""
    count, level = value.shape[axis], torch.arange(width)
    twice = torch.cat([level, level])
    if count == 2 * width:
        source, copy = torch.cat([twice, width + twice]), torch.cat([twice >= 0, twice >= 0])
    else:
        others = torch.arange(count - width)
        source = torch.cat([others, count - width + twice])
        copy = torch.cat([others < 0, twice >= 0])
    found = value.index_select(axis, source)
    if axis == 0:
        return found
    share = 0.5 + _UNEVEN * (torch.rand(width, generator=generator) - 0.5)
    pair = torch.cat([share, 1 - share])
    shares = torch.ones(len(source))
    shares[copy] = pair.repeat(int(copy.sum()) // len(pair))
    return found * shares.view([-1 if k == 1 else 1 for k in range(found.ndim)])


def _place_times(name: str, value: Tensor, into: Tensor, width: int) -> None:
    """The time's embedding, in place: its waves are every second one of the wider network's."""
    if name == "time_embedding.linear_1.weight":
        half = width // 2
        into[: len(value)].zero_()
        into[: len(value), : 2 * half : 2] = value[:, :half]
        into[: len(value), 2 * half :: 2] = value[:, half:]
    elif name == "time_embedding.linear_2.weight":
        into[: len(value)].zero_()
        into[: len(value), : value.shape[1]] = value
    elif name.endswith(".weight"):
        into.zero_()
        rows = torch.arange(len(into)) % len(value)
        into[:, : value.shape[1]] = value[rows]
    elif name.startswith("time_embedding."):
        into[: len(value)] = value
    else:
        into.copy_(value[torch.arange(len(into)) % len(value)])


@torch.no_grad()
def grow(unet: UNet2DConditionModel, width: int, small: dict[str, Tensor]) -> None:
    """Put the weights `small` of a UNet, whose first level has `width` channels, one level deeper into `unet`."""
    target = unet.state_dict()
    generator = torch.Generator().manual_seed(0)
    for name, value in small.items():
        own = _DOWN_BLOCK.sub(lambda match: f"down_blocks.{int(match[1]) + 1}.", name)
        if own in target and not own.startswith("conv_in."):
            target[own].copy_(_widened(value, target[own].shape, width, generator))
    _identity(target["down_blocks.1.resnets.0.conv_shortcut.weight"], width)
    target["down_blocks.1.resnets.0.conv_shortcut.bias"].zero_()
    # The new level: in, the picture as it is and what may be learnt beside it; then the smaller network's first layer.
    inputs = target["conv_in.weight"].shape[1]
    target["conv_in.weight"][:inputs].zero_()
    target["conv_in.bias"][:inputs].zero_()
    _identity(target["conv_in.weight"][:inputs], inputs)
    down = target["down_blocks.0.downsamplers.0.conv.weight"]
    down.zero_()
    down[:, :inputs].copy_(with_region(small[FIRST_LAYER], inputs))
    target["down_blocks.0.downsamplers.0.conv.bias"].copy_(small["conv_in.bias"])
    target["down_blocks.0.resnets.0.conv2.weight"].zero_()
    target["down_blocks.0.resnets.0.conv2.bias"].zero_()
    # Out: what the smaller network would hand to its last layer, twice as large, and corrections that start at zero.
    last = len(unet.up_blocks) - 1
    up = target[f"up_blocks.{last - 1}.upsamplers.0.conv.weight"]
    up.zero_()
    for channel in range(len(up)):
        up[channel, channel, 1, 1] = 1
    target[f"up_blocks.{last - 1}.upsamplers.0.conv.bias"].zero_()
    for number in (0, 1):
        block = f"up_blocks.{last}.resnets.{number}"
        target[f"{block}.conv2.weight"].zero_()
        target[f"{block}.conv2.bias"].zero_()
        target[f"{block}.conv_shortcut.weight"].zero_()
        target[f"{block}.conv_shortcut.bias"].zero_()
        _identity(target[f"{block}.conv_shortcut.weight"], width)
    unet.load_state_dict(target)


def _identity(weight: Tensor, width: int) -> None:
    """Make a convolution hand over channels modulo `width`, in place: out k is in k, the first of its copies."""
    middle = weight.shape[-1] // 2
    weight.zero_()
    for channel in range(len(weight)):
        weight[channel, channel % width, middle, middle] = 1


def _widened(value: Tensor, shape: torch.Size, width: int, generator: torch.Generator) -> Tensor:
    """A tensor whose axes of the first level's channels are repeated up to `shape`; sums over inputs stay the same."""
    for axis, (before, after) in enumerate(zip(value.shape, shape, strict=True)):
        if before == after:
            continue
        source = _copied_channels(before, after, width)
        wide = value.index_select(axis, source)
        if axis == 1:
            share = 1 + _UNEVEN * (2 * torch.rand(after, generator=generator) - 1)
            total = torch.zeros(before).index_add(0, source, share)
            wide = wide * (share / total[source]).view([-1 if k == 1 else 1 for k in range(wide.ndim)])
        value = wide
    return value


def _copied_channels(before: int, after: int, width: int) -> Tensor:
    """For each of `after` channels the one of `before` that it repeats.

    The first level's `width` channels come alone, after a deeper level's as the part that skips (they are then last),
    or before the network's own input (they are then first, and the last `width` are not repeated).
    """
    every = torch.arange(before)
    extra = after - before
    repeated = every[:width] if before <= 2 * width else every[-width:]
    copies = repeated.repeat(-(-extra // width))[:extra]
    if before == 2 * width:
        return torch.cat([every[:width], copies, every[width:]])
    return torch.cat([every, copies])
