"""From a model's name to loaded components: a folder, a hub id or `builtin`, checked before anything is loaded."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from fd_mitsuba.backend.collector import uncollected
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError, first_line, out_of_memory
from fd_mitsuba.guidance.builtin import builtin_folder, shipped_folder
from fd_mitsuba.guidance.control import check_controlnet, locate_controlnet
from fd_mitsuba.guidance.image_prompt import add_image_prompt, asks_for_image_prompt
from fd_mitsuba.guidance.layout import (
    LAYOUT,
    LAYOUT_NAME,
    WEIGHTS,
    latent_side,
)
from fd_mitsuba.guidance.learned_words import add_word
from fd_mitsuba.guidance.lora import add_lora, lora_files
from fd_mitsuba.guidance.memory import BYTES, critic_bytes, require_memory, working_set_bytes
from fd_mitsuba.guidance.model_conventions import FILE_NAME, ModelConventions
from fd_mitsuba.guidance.model_headers import read_headers
from fd_mitsuba.guidance.multiview import join_views
from fd_mitsuba.guidance.multiview_layout import converted_unet
from fd_mitsuba.guidance.network_passes import rows_at_once
from fd_mitsuba.guidance.variants import critic_rank
from fd_mitsuba.io.hub import hub_snapshot, is_offline, local_folder

HUB_FILES = ["model_index.json", FILE_NAME, "tokenizer/*", "scheduler/*.json"] + [
    f"{part}/{name}" for part, stem in WEIGHTS.items() for name in ("config.json", f"{stem}*.safetensors*")
]


@dataclass(frozen=True)
class Components:
    """The parts of a pipeline, in evaluation mode, without gradients in the weights.

    `Any`, since each is of one of several classes, whose `config` the libraries make up while they load.
    """

    tokenizer: Any
    text_encoder: Any
    unet: Any
    vae: Any
    scheduler: Any
    conventions: ModelConventions
    folder: Path
    words: dict[str, str] = field(default_factory=dict)
    """Learned words, and the tokens that stand for them."""
    controlnet: torch.nn.Module | None = None
    image_prompt: torch.Tensor | None = None
    """(1, width), what the image encoder says of the picture; the UNet has an IP-Adapter then."""


def load_components(config: GuidanceConfig, device: str = "cpu", appearance: bool = False) -> Components:
    """The components of `config.model`, in `config.dtype` (the VAE in float32, since gradients flow through it).

    Beside another device the text encoder stays on the CPU, in float32: it reads each text once.

    Args:
        appearance: `builtin` means the prior of colours, not the one of shapes.

    Raises:
        UserError: one line that names the file and what to do, for a folder or hub id that does not exist, a layout
            other than Stable Diffusion's, a missing or damaged file, weights that do not fit the config, no memory.
    """
    headers = read_headers(locate(config.model, appearance), config)
    folder, configs, counts, conventions = headers.folder, headers.configs, headers.counts, headers.conventions
    control, control_weights, control_variant = None, 0, None
    if config.controlnet:
        control = locate_controlnet(config.controlnet)
        control_weights, control_variant = check_controlnet(control, configs["unet"])
    size = BYTES[config.dtype]
    text_size = size if torch.device(device).type == "cpu" else 0
    latent_size = latent_side(configs["unet"])
    most, together = config.views_per_call, conventions.views_together or 1
    working = working_set_bytes(configs["unet"], configs["vae"], latent_size, most, config.dtype, together)
    taught = rows_at_once(most, 2, together)
    working += critic_bytes(configs["unet"], latent_size, taught, config.dtype, critic_rank(config))
    require_memory(
        (counts["unet"] + control_weights) * size + counts["text_encoder"] * text_size + counts["vae"] * 4,
        working,
        device,
        str(folder),
    )
    unet = _converted(headers.files["unet"], configs["unet"], config) if headers.is_original else None
    loaded = _with_additions(_load(folder, headers.index, headers.variants, config, conventions, device, unet), config)
    if conventions.views_together is not None:
        join_views(loaded.unet, conventions.views_together)
    if control is None:
        return loaded
    return replace(loaded, controlnet=_load_controlnet(control, control_variant, config, device))


def _with_additions(loaded: Components, config: GuidanceConfig) -> Components:
    """The components after LoRA files and learned words were added to them."""
    for file in lora_files(config.lora):
        add_lora(file, config.lora_scale, loaded.unet, loaded.text_encoder)
    words = [add_word(Path(path).expanduser(), loaded.tokenizer, loaded.text_encoder) for path in config.words]
    picture = None
    if asks_for_image_prompt(config):
        names = ("vae", "text_encoder", "tokenizer", "unet", "scheduler")
        with quiet_loading():
            picture = add_image_prompt(config, {name: getattr(loaded, name) for name in names})
    return replace(loaded, words=dict(words), image_prompt=picture)


def locate(model: str, appearance: bool = False, setting: str = "guidance.model") -> Path:
    """The folder of a model name: `builtin`, an existing folder, or a snapshot of a hub id (fetched, unless offline).

    `HF_HUB_OFFLINE=1` keeps to what is in the hub's cache.

    Args:
        setting: what names the model, for messages.
    """
    if (shipped := shipped_folder(model, appearance)) is not None:
        return builtin_folder(shipped)
    folder = local_folder(model, setting, LAYOUT_NAME)
    return _snapshot(model) if folder is None else folder


def _snapshot(model: str) -> Path:
    folder = hub_snapshot(model, HUB_FILES, ["*.fp16.*", "*.non_ema.*", "*.bf16.*"])
    if not is_offline() and (folder / "model_index.json").is_file() and not _has_plain_weights(folder):
        return hub_snapshot(model, HUB_FILES, ["*.non_ema.*"])
    return folder


def _has_plain_weights(folder: Path) -> bool:
    return all(
        any((folder / part / f"{stem}.safetensors{ending}").is_file() for ending in ("", ".index.json"))
        for part, stem in WEIGHTS.items()
    )


def _load(
    folder: Path,
    index: dict[str, Any],
    variants: dict[str, str | None],
    config: GuidanceConfig,
    conventions: ModelConventions,
    device: str,
    unet: torch.nn.Module | None = None,
) -> Components:
    with uncollected():  # what these name is imported when it is asked for
        import diffusers
        import transformers

        unet_class, text_class = diffusers.UNet2DConditionModel, transformers.CLIPTextModel
        vae_class = getattr(diffusers, index["vae"][1])
    dtype = getattr(torch, config.dtype)
    on_cpu = torch.device(device).type == "cpu"
    scheduler_class = getattr(diffusers, index["scheduler"][1], None)
    if scheduler_class is None:
        raise UserError(
            f"{folder / 'model_index.json'}: unknown scheduler {index['scheduler'][1]}; name a DDIMScheduler"
        )
    loaded: dict[str, Any] = {}
    wanted: tuple[tuple[str, Any, torch.dtype], ...] = (
        ("unet", unet_class, dtype),
        ("vae", vae_class, torch.float32),
        ("text_encoder", text_class, dtype if on_cpu else torch.float32),
    )
    for part, network_class, kind in wanted:
        owner: Any = network_class
        key = "torch_dtype" if part != "text_encoder" else "dtype"
        if part == "unet" and unet is not None:
            model = unet
        else:
            model = _network(owner, folder / part, variants[part], **{key: kind})
        loaded[part] = model.to("cpu" if part == "text_encoder" else device)
    with _one_line(folder / "tokenizer"), quiet_loading():
        # A tokenizer of the generic class keeps the rules in its own file; the CLIP class would impose CLIP's.
        generic = index["tokenizer"][1] == "PreTrainedTokenizerFast"
        owner = transformers.PreTrainedTokenizerFast if generic else transformers.CLIPTokenizer
        tokenizer = owner.from_pretrained(str(folder / "tokenizer"), local_files_only=True)
        tokenizer("a")  # one without words is only told as it reads
    known = loaded["text_encoder"].config.vocab_size
    if len(tokenizer) > known:
        raise UserError(
            f"{folder / 'tokenizer'}: has {len(tokenizer)} words, the text encoder knows {known}; fetch the model again"
        )
    with _one_line(folder / "scheduler"), quiet_loading():
        scheduler = scheduler_class.from_pretrained(str(folder / "scheduler"), local_files_only=True)
    if not hasattr(scheduler, "alphas_cumprod"):
        raise UserError(f"{folder / 'scheduler'}: {index['scheduler'][1]} has no noise levels alphas_cumprod; {LAYOUT}")
    if not torch.isfinite(scheduler.alphas_cumprod).all():
        raise UserError(f"{folder / 'scheduler'}: its noise levels are not finite; fetch the model again")
    return Components(tokenizer, loaded["text_encoder"], loaded["unet"], loaded["vae"], scheduler, conventions, folder)


def _converted(files: list[Path], unet: dict[str, Any], config: GuidanceConfig) -> torch.nn.Module:
    with _one_line(files[0].parent), quiet_loading():
        return converted_unet(files, unet, getattr(torch, config.dtype))


def _load_controlnet(folder: Path, variant: str | None, config: GuidanceConfig, device: str) -> torch.nn.Module:
    import diffusers

    kind = getattr(torch, config.dtype)
    return _network(diffusers.ControlNetModel, folder, variant, torch_dtype=kind).to(device)


def _network(owner: Any, folder: Path, variant: str | None, **kind: torch.dtype) -> torch.nn.Module:
    with _one_line(folder), quiet_loading():
        model, info = owner.from_pretrained(
            str(folder),
            variant=variant,
            use_safetensors=True,
            local_files_only=True,
            output_loading_info=True,
            **kind,
        )
    missing = sorted(info["missing_keys"])
    if missing:
        raise UserError(f"{folder}: the weights lack {len(missing)} tensors, {missing[0]} first; fetch the file again")
    return model.requires_grad_(False).eval()


@contextlib.contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turn whatever the libraries raise on a file that does not fit its config into one line that names the place."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        if problem := out_of_memory(error):
            raise UserError(f"{path}: {problem}, or set guidance.dtype=bfloat16") from None
        raise UserError(f"{path}: cannot be loaded ({first_line(error)}); copy or fetch the model again") from None


@contextlib.contextmanager
def quiet_loading() -> Iterator[None]:
    """No progress bars and remarks of the libraries while a component loads; what matters is checked here."""
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    levels = [(library, library.get_verbosity()) for library in (diffusers_logging, transformers_logging)]
    bar = transformers_logging.is_progress_bar_enabled()
    for library, _ in levels:
        library.set_verbosity_error()
    transformers_logging.disable_progress_bar()
    try:
        yield
    finally:
        for library, level in levels:
            library.set_verbosity(level)
        if bar:
            transformers_logging.enable_progress_bar()
