"""From a CLIP model's name to its network and tokenizer: the built-in evaluator, a folder, or a hub id."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from fd_mitsuba.errors import UserError, first_line
from fd_mitsuba.guidance.builtin import verify_hashes
from fd_mitsuba.guidance.layout import read_json
from fd_mitsuba.io.hub import hub_snapshot, local_folder

if TYPE_CHECKING:
    from transformers import CLIPModel

EVALUATOR_FOLDER = Path(__file__).resolve().parent.parent / "weights" / "evaluator"
BUILTIN_NAME = "built-in evaluator"
_USUAL = {
    "image_mean": (0.48145466, 0.4578275, 0.40821073),
    "image_std": (0.26862954, 0.26130258, 0.27577711),
}
"""What every published CLIP subtracts and divides by."""
_HUB_FILES = [
    "*config.json",
    "fd_mitsuba.json",
    "tokenizer*",
    "vocab.json",
    "merges.txt",
    "special_tokens_map.json",
    "model*.safetensors*",
]
_REMEDY = "copy or fetch the model again"


def locate_clip(model: str | None) -> tuple[Path, str]:
    """The folder of a CLIP model and the name that its figures go by.

    Args:
        model: None or `builtin`; a folder; a hub id, fetched if needed, unless `HF_HUB_OFFLINE` is set.

    Raises:
        UserError: nothing there, no evaluator in this installation, or one whose files were changed.
    """
    if model is None or model == "builtin":
        if not (EVALUATOR_FOLDER / "config.json").is_file():
            raise UserError(
                f"{EVALUATOR_FOLDER}: this installation has no built-in evaluator; reinstall fd_mitsuba, or name the "
                "folder or hub id of a CLIP model"
            )
        verify_hashes(EVALUATOR_FOLDER)
        return EVALUATOR_FOLDER, BUILTIN_NAME
    folder = local_folder(model, "--judge", "Transformers' CLIP layout")
    return _snapshot(model) if folder is None else folder, model


def read_clip_conventions(folder: Path) -> dict[str, Any]:
    """The keyword arguments of `ClipJudge` in `folder/fd_mitsuba.json`; none without that file."""
    if not (folder / "fd_mitsuba.json").is_file():
        return {}
    said = read_json(folder / "fd_mitsuba.json")
    return {key: said[key] for key in ("geometry_pictures", "whole_words") if key in said}


def read_preprocessing(folder: Path) -> tuple[int, int, tuple, tuple]:
    """Shorter side, crop, mean and standard deviation from `preprocessor_config.json`; CLIP's own means by default.

    Raises:
        UserError: no such file, or sizes that are not square.
    """
    path = folder / "preprocessor_config.json"
    if not path.is_file():
        raise UserError(f"{path}: missing, so nobody knows how the model wants its pictures; {_REMEDY}")
    said = read_json(path)
    try:
        size = said.get("size", 224)
        resize = size if isinstance(size, int) else size.get("shortest_edge", size.get("height"))
        crop = said.get("crop_size", resize) if said.get("do_center_crop", True) else resize
        crop = crop if isinstance(crop, int) else crop["height"]
        mean, std = (tuple(map(float, said.get(key, usual))) for key, usual in _USUAL.items())
        if len(mean) != 3 or len(std) != 3 or min(std) <= 0 or not 0 < crop <= int(resize):
            raise ValueError("sizes or means out of range")
        return int(resize), int(crop), mean, std
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: not a CLIP preprocessor ({first_line(error)}); {_REMEDY}") from None


def open_clip(folder: Path) -> tuple[CLIPModel, Any]:
    """The network in float32 and the tokenizer, from local files alone.

    Raises:
        UserError: a file is missing or damaged, the config is another kind of model's, weights that lack a tensor.
    """
    import transformers

    kind = read_json(folder / "config.json").get("model_type")
    if kind != "clip":
        raise UserError(f"{folder / 'config.json'}: a model of type {kind!r}, not 'clip'; name a CLIP model")
    try:
        with _no_progress_bar():
            loaded: Any = transformers.CLIPModel.from_pretrained(
                str(folder), dtype=torch.float32, local_files_only=True, output_loading_info=True
            )
        model, info = loaded
        tokenizer = transformers.AutoTokenizer.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # the libraries raise many kinds: a missing or cut file, tensors of another size
        raise UserError(f"{folder}: cannot be loaded as a CLIP model ({first_line(error)}); {_REMEDY}") from None
    missing = sorted(info["missing_keys"])
    if missing:
        raise UserError(f"{folder}: the weights lack {len(missing)} tensors, {missing[0]} first; {_REMEDY}")
    return model, tokenizer


@contextlib.contextmanager
def _no_progress_bar() -> Iterator[None]:
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def _snapshot(model: str) -> Path:
    folder = hub_snapshot(model, _HUB_FILES)
    if not list(folder.glob("model*.safetensors*")):
        # The first CLIP models have pickled weights alone; Transformers reads them without running what they hold.
        folder = hub_snapshot(model, [*_HUB_FILES, "pytorch_model.bin"])
    return folder
