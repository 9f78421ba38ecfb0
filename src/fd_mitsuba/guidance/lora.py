"""LoRA files on top of a model: low-rank changes of its weights, added once as the model is loaded.

    W <- W + scale (alpha / rank) up down

Names are read as Diffusers and PEFT write them (`unet.….to_q.lora_A.weight`), as older Diffusers did
(`….to_q.lora.down.weight`, `….processor.to_q_lora.down.weight`) and as kohya's trainers do
(`lora_unet_…_to_q.lora_down.weight`, `….alpha`).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from fd_mitsuba.errors import UserError, first_line

_KEY = re.compile(r"^(?P<place>.+?)[._]lora(?:_linear_layer)?[._](?P<side>A|B|down|up)(?:\.\w+)?\.weight$")
_COMPONENTS = {
    "unet": ("unet.", "lora_unet_"),
    "text_encoder": ("text_encoder.", "lora_te_", "lora_te1_"),
}
_UNREAD = ("use_dora", "use_rslora", "rank_pattern", "alpha_pattern")
"""Entries of PEFT's adapter config that change the formula above."""


@dataclass
class _Change:
    """Of one layer."""

    down: Tensor | None = None
    up: Tensor | None = None
    alpha: float | None = None


@dataclass
class _Changes:
    """Of one file: component -> place with underscores for dots -> change."""

    path: Path
    layers: dict[str, dict[str, _Change]] = field(default_factory=lambda: {name: {} for name in _COMPONENTS})


@torch.no_grad()
def add_lora(path: Path, scale: float, unet: torch.nn.Module, text_encoder: torch.nn.Module) -> int:
    """Add a LoRA file's changes to the weights of both; returns how many layers were changed.

    Args:
        path: a .safetensors file, or a folder with one.

    Raises:
        UserError: no such file, a damaged one, one that is no LoRA or of a kind with more to it (DoRA, LoKr, LoHa), or
            one that was made for a model with other layers or widths. Nothing is changed then.
    """
    file = lora_file(path)
    found = _read(file)
    planned = []
    for name, model in (("unet", unet), ("text_encoder", text_encoder)):
        layers = _by_flat_name(model)
        for place, change in found.layers[name].items():
            layer = layers.get(place) or layers.get(place.removeprefix("text_model_"))
            if layer is None:
                raise UserError(f"{file}: changes {name} {place}, which this model does not have; {_OTHER_MODEL}")
            planned.append((layer, _delta(file, f"{name} {place}", change, layer.weight)))
    for layer, delta in planned:
        weight = layer.weight
        weight.copy_((weight.float() + scale * delta.to(weight.device)).to(weight.dtype))
    return len(planned)


def lora_file(path: Path, setting: str = "guidance.lora") -> Path:
    """The .safetensors file of a path: itself, or the only one in a folder."""
    if path.is_dir():
        files = sorted(path.glob("*.safetensors"))
        if len(files) != 1:
            raise UserError(f"{path}: holds {len(files)} .safetensors files; name the one that is meant")
        return files[0]
    if not path.is_file():
        raise UserError(f"{path}: no such file or folder; correct {setting}")
    if path.suffix != ".safetensors":
        raise UserError(f"{path}: is no .safetensors file; others can run code as they are loaded, so convert it")
    return path


def lora_files(paths: Iterable[str]) -> list[Path]:
    """The files of `guidance.lora`; UserError where one is missing, or named twice, which would add it twice."""
    files: dict[Path, Path] = {}
    for path in paths:
        file = lora_file(Path(path).expanduser())
        if file.resolve() in files:
            raise UserError(
                f"{file}: is named twice in guidance.lora; remove one, and use guidance.lora_scale for more"
            )
        files[file.resolve()] = file
    return list(files.values())


def refuse_non_finite(file: Path, key: str, value: Tensor) -> None:
    """UserError where a tensor of a file has a NaN or an infinite value, which would spread to all that is guided."""
    if not torch.isfinite(value.float()).all():  # there is no `isfinite` of 8 bits
        raise UserError(f"{file}: {key} has values that are not finite; fetch the file again, or take another")


_OTHER_MODEL = "it was made for another one; take a LoRA for the model that guidance.model names"


def _by_flat_name(model: torch.nn.Module) -> dict[str, torch.nn.Linear | torch.nn.Conv2d]:
    kinds = (torch.nn.Linear, torch.nn.Conv2d)
    return {name.replace(".", "_"): layer for name, layer in model.named_modules() if isinstance(layer, kinds)}


def _read(file: Path) -> _Changes:
    from safetensors import SafetensorError, safe_open

    found = _Changes(file)
    try:
        with safe_open(file, framework="pt") as tensors:
            settings = _adapter_settings(file, tensors.metadata() or {})
            for key in tensors.keys():  # noqa: SIM118
                _take(found, key, tensors.get_tensor(key))
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file}: damaged ({first_line(error)}); fetch the file again") from None
    for name, changes in found.layers.items():
        for change in changes.values():
            change.alpha = settings.get(name) if change.alpha is None else change.alpha
    if not any(found.layers.values()):
        raise UserError(f"{file}: holds no LoRA; take a file that Diffusers, PEFT or kohya's trainers wrote")
    return found


def _adapter_settings(file: Path, metadata: dict[str, str]) -> dict[str, float]:
    """Component -> alpha for all of its layers, where PEFT wrote it down."""
    try:
        known = json.loads(metadata.get("lora_adapter_metadata", "{}"))
    except (ValueError, RecursionError):
        raise UserError(f"{file}: its lora_adapter_metadata is not JSON; fetch the file again") from None
    if not isinstance(known, dict):
        raise UserError(f"{file}: its lora_adapter_metadata is no JSON object; fetch the file again")
    for key, value in known.items():
        if key.rpartition(".")[2] in _UNREAD and value:
            raise UserError(f"{file}: its {key} = {value!r} is not read here; take a plain LoRA")
    alphas = {name: known[f"{name}.lora_alpha"] for name in _COMPONENTS if f"{name}.lora_alpha" in known}
    for name, alpha in alphas.items():
        if isinstance(alpha, bool) or not isinstance(alpha, int | float) or not math.isfinite(alpha):
            raise UserError(f"{file}: its {name}.lora_alpha is {alpha!r}, not a finite number; fetch the file again")
    return {name: float(alpha) for name, alpha in alphas.items()}


def _take(found: _Changes, key: str, value: Tensor) -> None:
    match = _KEY.match(key)
    place = match["place"] if match else key.removesuffix(".alpha")
    prefix = next((p for prefixes in _COMPONENTS.values() for p in prefixes if place.startswith(p)), None)
    if prefix is None or (match is None and not key.endswith(".alpha")):
        raise UserError(
            f"{found.path}: {key} is no part of a plain LoRA for Stable Diffusion 1.x/2.x; take another file"
        )
    component = next(name for name, prefixes in _COMPONENTS.items() if prefix in prefixes)
    place = place.removeprefix(prefix).replace(".processor.", ".").removesuffix("_lora")
    place = re.sub(r"\.to_out$", ".to_out.0", place).replace(".", "_")
    refuse_non_finite(found.path, key, value)
    change = found.layers[component].setdefault(place, _Change())
    if match is None:
        if value.numel() != 1:
            raise UserError(f"{found.path}: {key} has {value.numel()} values, not one; fetch the file again")
        change.alpha = float(value)
    elif match["side"] in ("A", "down"):
        change.down = value.float()
    else:
        change.up = value.float()


def _delta(file: Path, place: str, change: _Change, weight: Tensor) -> Tensor:
    """(alpha / rank) up down in the shape of the layer's weight."""
    if change.down is None or change.up is None:
        raise UserError(f"{file}: {place} lacks one of its two matrices; fetch the file again")
    shapes = f"{tuple(change.down.shape)} and {tuple(change.up.shape)}"
    if min(change.down.ndim, change.up.ndim) < 2 or not len(change.down):
        raise UserError(f"{file}: {place}: {shapes} are no two matrices of a rank above 0; fetch the file again")
    rank, fits = len(change.down), change.up.shape[1] == len(change.down)
    product = change.up.flatten(1) @ change.down.flatten(1) if fits and change.up.flatten(1).shape[1] == rank else None
    if product is None or len(product) != len(weight) or product.numel() != weight.numel():
        raise UserError(f"{file}: {place}: matrices {shapes} for a weight {tuple(weight.shape)}; {_OTHER_MODEL}")
    return (change.alpha if change.alpha is not None else rank) / rank * product.view(weight.shape)
