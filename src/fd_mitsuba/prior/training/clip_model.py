"""The built-in evaluator's network, a small CLIP in Transformers' layout, and how it is packed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tokenizers import Regex, normalizers
from torch import Tensor
from transformers import CLIPConfig, CLIPModel, CLIPTextConfig, CLIPVisionConfig, PreTrainedTokenizerFast

from fd_mitsuba.guidance.builtin import SUMS_NAME, write_hashes
from fd_mitsuba.prior.pictures.clip_corpus import PATCH, SIZE
from fd_mitsuba.prior.training.model import TEXT_LENGTH, build_tokenizer, token_numbers

WIDTH, LAYERS, TEXT_LAYERS, HEADS, FEATURES = 128, 4, 2, 4, 128
CONVENTIONS = {
    "geometry_pictures": "normals",
    "normal_space": "camera",
    "backgrounds": {"normals": "black", "lit": "grey"},
    "whole_words": True,
}


def build_clip_tokenizer() -> PreTrainedTokenizerFast:
    """The prior's tokenizer without the signs it does not know.

    It would turn an unknown sign into its end token, at which CLIP's text model stops reading.
    """
    tokenizer = build_tokenizer()
    tokenizer.backend_tokenizer.normalizer = normalizers.Sequence(
        [
            normalizers.NFD(),
            normalizers.StripAccents(),
            normalizers.Lowercase(),
            normalizers.Replace(Regex(r"[^a-z0-9,.\-' ]"), " "),
        ]
    )
    return tokenizer


def build_clip(tokenizer: PreTrainedTokenizerFast) -> CLIPModel:
    """The dual encoder with fresh weights; its picture positions start as waves, so that neighbours are alike."""
    shared: dict[str, Any] = {"hidden_size": WIDTH, "intermediate_size": 4 * WIDTH, "num_attention_heads": HEADS}
    text = CLIPTextConfig(
        vocab_size=len(tokenizer),
        num_hidden_layers=TEXT_LAYERS,
        max_position_embeddings=TEXT_LENGTH,
        # The text is read where this token comes first; with the library's default, 2, it would be read elsewhere.
        **token_numbers(tokenizer),
        projection_dim=FEATURES,
        **shared,
    )
    vision = CLIPVisionConfig(
        num_hidden_layers=LAYERS, image_size=SIZE, patch_size=PATCH, projection_dim=FEATURES, **shared
    )
    config = CLIPConfig(text_config=text.to_dict(), vision_config=vision.to_dict(), projection_dim=FEATURES)
    model = CLIPModel(config)
    with torch.no_grad():
        model.vision_model.embeddings.position_embedding.weight[1:] = _waves(SIZE // PATCH, WIDTH)
    return model


def _waves(cells: int, width: int) -> Tensor:
    """Sines and cosines (cells cells, width) of the row and the column of each cell, at falling frequencies."""
    frequency = 0.05 ** torch.linspace(0, 1, width // 4)
    place = torch.arange(cells, dtype=torch.float32)[:, None] * frequency
    waves = 0.2 * torch.cat([place.sin(), place.cos()], 1)
    rows, columns = waves[:, None].expand(-1, cells, -1), waves[None].expand(cells, -1, -1)
    return torch.cat([rows, columns], -1).reshape(cells * cells, width)


def save_evaluator(model: CLIPModel, folder: Path, about: dict | None = None) -> None:
    """Write network (fp16), tokenizer, preprocessing, conventions and the list of hashes.

    Args:
        folder: created; existing files are replaced.
        about: remarks for people, put into the conventions.
    """
    folder.mkdir(parents=True, exist_ok=True)
    model.half().save_pretrained(folder)
    build_clip_tokenizer().save_pretrained(folder)
    preprocessing = {
        "image_processor_type": "CLIPImageProcessor",
        "do_convert_rgb": True,
        "do_resize": True,
        "resample": 3,
        "size": {"shortest_edge": SIZE},
        "do_center_crop": True,
        "crop_size": {"height": SIZE, "width": SIZE},
        "do_rescale": True,
        "rescale_factor": 1 / 255,
        "do_normalize": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    for name, content in (
        ("preprocessor_config.json", preprocessing),
        ("fd_mitsuba.json", {**CONVENTIONS, "about": about or {}}),
    ):
        (folder / name).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    write_hashes(folder, (path for path in folder.iterdir() if path.is_file() and path.name != SUMS_NAME))
