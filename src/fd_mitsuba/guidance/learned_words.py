"""Textual inversion: words whose vectors were learned from pictures, added to a model's tokenizer and text encoder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fd_mitsuba.errors import UserError, first_line
from fd_mitsuba.guidance.lora import lora_file, refuse_non_finite

_UNNAMED = "emb_params"
"""The key of files that other programs write; the file's name is the word then."""


@torch.no_grad()
def add_word(path: Path, tokenizer: Any, text_encoder: Any) -> tuple[str, str]:
    """Add the word of a .safetensors file, or of a folder with one; returns it, and the tokens that stand for it.

    A word of several vectors has a token for each: `<cat>`, `<cat>_1`, ..., as in Diffusers.

    Raises:
        UserError: no such file, a damaged one or one of another kind, vectors of another width, a word that is known.
    """
    file = lora_file(path, "guidance.words")
    word, vectors = _read(file)
    if not word.strip():
        raise UserError(f"{file}: its word is {word!r}; name the tensor in the file after the word")
    refuse_non_finite(file, word, vectors)
    width = text_encoder.get_input_embeddings().weight.shape[1]
    if not vectors.numel():
        raise UserError(f"{file}: holds no vectors {tuple(vectors.shape)}; fetch the file again")
    if vectors.ndim != 2 or vectors.shape[1] != width:
        raise UserError(
            f"{file}: vectors {tuple(vectors.shape)}, but this model's words have {width} numbers; take an embedding "
            "for the model that guidance.model names"
        )
    tokens = [word, *(f"{word}_{index}" for index in range(1, len(vectors)))]
    if known := set(tokens) & tokenizer.get_vocab().keys():
        raise UserError(f"{file}: the model knows {sorted(known)[0]!r} already; rename the word in the file")
    tokenizer.add_tokens(tokens)
    text_encoder.resize_token_embeddings(len(tokenizer), mean_resizing=False)
    table = text_encoder.get_input_embeddings().weight
    for token, vector in zip(tokens, vectors, strict=True):
        table[tokenizer.convert_tokens_to_ids(token)] = vector.to(table)
    text_encoder.requires_grad_(False)
    return word, " ".join(tokens)


def _read(file: Path) -> tuple[str, Tensor]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(file, framework="pt") as tensors:
            content = {key: tensors.get_tensor(key).float() for key in tensors.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise UserError(f"{file}: damaged ({first_line(error)}); fetch the file again") from None
    if _UNNAMED in content:
        return file.stem, _rows(content[_UNNAMED])
    if len(content) != 1:
        raise UserError(f"{file}: holds {len(content)} tensors, not the vectors of one word; take an embedding")
    ((word, vectors),) = content.items()
    return word, _rows(vectors)


def _rows(vectors: Tensor) -> Tensor:
    return vectors.view(1, -1) if vectors.ndim == 1 else vectors
