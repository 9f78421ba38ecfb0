"""Text per picture, depending on where the camera stands, and its embedding.

A template such as "{prompt}, {closeup}, {view}" is filled for each picture (or mosaic). {view} is a word for the
azimuth: front, side or back view by default, or one of those the model was trained with (`ModelConventions`).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch

from fd_mitsuba.guidance.model_conventions import ModelConventions

logger = logging.getLogger(__name__)


def view_word(azimuth_deg: float, conventions: ModelConventions) -> str:
    """The word for an azimuth; for a mosaic of n views, that of its first view, whose azimuth counts modulo 360 / n.

    Bin k of `view_words` is [start + k width, start + (k + 1) width) with width = 360 / words for pictures and
    360 / n / words for mosaics.
    """
    views = conventions.view_grid**2
    if not conventions.view_words:
        if views > 1:
            return ""
        from fd_mitsuba.scene.views import view_label

        return f"{view_label(float(azimuth_deg))} view"
    period = 360.0 / views
    width = period / len(conventions.view_words)
    start = conventions.view_start_deg
    if start is None:
        start = -width / 2 if views == 1 else 0.0
    index = int(((float(azimuth_deg) - start) % period) / width)
    return conventions.view_words[min(index, len(conventions.view_words) - 1)]


def view_prompt(prompt: str, azimuth_deg: float, closeup: bool, conventions: ModelConventions, with_view: bool) -> str:
    """The template filled for one picture; `with_view` False leaves {view} and {closeup} empty."""
    values = {
        "prompt": prompt,
        "view": view_word(azimuth_deg, conventions) if with_view else "",
        "closeup": conventions.closeup_word if with_view and closeup else "",
    }
    # The template is split before it is filled: commas of the prompt itself stay as they are.
    items = (item.format(**values).strip() for item in conventions.prompt_template.split(","))
    return ", ".join(item for item in items if item)


def unknown_words(tokenizer: Any, text: str) -> list[str]:
    """Words of `text` that the tokenizer splits. Tells something only of a tokenizer that knows whole words."""
    words = dict.fromkeys(re.findall(r"[^\W\d_]+", text.lower()))
    return [word for word in words if len(tokenizer.tokenize(word)) > 1]


class TextEmbeddings:
    """Text to CLIP hidden states, each distinct text encoded once.

    Args:
        tokenizer: a CLIP tokenizer; texts are padded to its `model_max_length` and cut there, with a warning.
        text_encoder: a `CLIPTextModel`; its last hidden state is the embedding, as in diffusers' pipelines.
        device: where the embeddings go; None: they stay on the encoder's.
        words: learned words, and the tokens that stand for each.
    """

    def __init__(
        self,
        tokenizer: Any,
        text_encoder: Any,
        device: torch.device | str | None = None,
        words: Mapping[str, str] | None = None,
    ) -> None:
        self.tokenizer = tokenizer
        self.text_encoder = text_encoder
        self.device = device
        self.words = dict(words or {})
        # A tokenizer saved without its length reports a huge number; the position table is the true limit.
        positions = text_encoder.config.max_position_embeddings
        self.length = min(tokenizer.model_max_length, positions)
        self._cache: dict[str, torch.Tensor] = {}

    @torch.no_grad()
    def __call__(self, texts: Sequence[str]) -> torch.Tensor:
        """Embeddings (len(texts), length, width) in the encoder's dtype."""
        self._encode(text for text in dict.fromkeys(texts) if text not in self._cache)
        return torch.cat([self._cache[text] for text in texts])

    def _encode(self, texts: Iterable[str]) -> None:
        for text in texts:
            written = self._written(text)
            tokens = self.tokenizer(
                written, padding="max_length", max_length=self.length, truncation=True, return_tensors="pt"
            )
            if len(self.tokenizer(written).input_ids) > self.length:
                logger.warning("the text encoder reads %d tokens; the end of %r is not seen", self.length, text)
            device = next(self.text_encoder.parameters()).device
            # Only encoders that were trained with a mask get one: Stable Diffusion attends to the padding too.
            masked = getattr(self.text_encoder.config, "use_attention_mask", False)
            mask = tokens.attention_mask.to(device) if masked else None
            embedding = self.text_encoder(tokens.input_ids.to(device), attention_mask=mask)[0]
            self._cache[text] = embedding.to(self.device or device)

    def _written(self, text: str) -> str:
        """The text with all tokens of each learned word."""
        for word, tokens in self.words.items():
            text = re.sub(rf"(?<!\w){re.escape(word)}(?!\w)", lambda match, tokens=tokens: tokens, text)
        return text
