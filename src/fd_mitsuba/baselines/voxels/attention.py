"""Where a diffusion model's cross-attention looks for words: maps of single views, recorded while the UNet runs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from fd_mitsuba.errors import UserError

_EMPTY_WORDS = frozenset("a an the with has having wearing on in of and to two three four pair its his her".split())


class AttentionRecorder:
    """An attention processor that notes the attention to text tokens and leaves the work to the one before it.

    Attributes:
        maps: what was seen: (B, pixels, tokens) each, averaged over heads.
    """

    def __init__(self, inner: Any, maps: list[Tensor]) -> None:
        self.inner, self.maps = inner, maps

    def __call__(
        self,
        attn: Any,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        *more: Any,
        **named: Any,
    ) -> Tensor:
        """As the inner processor."""
        if encoder_hidden_states is not None and hidden_states.ndim == 3:
            with torch.no_grad():
                query = attn.head_to_batch_dim(attn.to_q(hidden_states))
                key = attn.head_to_batch_dim(attn.to_k(encoder_hidden_states))
                seen = attn.get_attention_scores(query, key)
                self.maps.append(seen.view(len(hidden_states), -1, *seen.shape[1:]).mean(dim=1).float().cpu())
        return self.inner(attn, hidden_states, encoder_hidden_states, attention_mask, *more, **named)


@contextmanager
def recorded_attention(unet: Any) -> Iterator[list[Tensor]]:
    """While open, every pass of the UNet adds its cross-attention, layer after layer, to the list that this gives.

    Raises:
        UserError: the UNet has no cross-attention.
    """
    before = unet.attn_processors
    maps: list[Tensor] = []
    # `attn2` is the cross-attention of a transformer block, `attn1` its self-attention.
    found = {name: AttentionRecorder(inner, maps) for name, inner in before.items() if ".attn2." in name}
    if not found:
        raise UserError("guidance.model: its UNet has no cross-attention to look for words; take voxe_global instead")
    unet.set_attn_processor({**before, **found})
    try:
        yield maps
    finally:
        unet.set_attn_processor(before)


def word_maps(maps: Sequence[Tensor], groups: Sequence[Sequence[int]], side: int) -> Tensor:
    """(len(groups), side, side): the largest attention to a group's tokens, averaged over the layers of that size.

    Args:
        maps: one view's, (1, pixels, tokens) each; square layers.
        groups: token positions.
        side: of the layers that count; without any of that size the largest that there are, resized.
    """
    sizes = {round(seen.shape[1] ** 0.5) for seen in maps}
    chosen = side if side in sizes else max(sizes)
    layers = torch.stack([seen[0] for seen in maps if round(seen.shape[1] ** 0.5) == chosen]).mean(dim=0)
    found = torch.stack([layers[:, list(group)].amax(dim=1) for group in groups]).view(len(groups), chosen, chosen)
    if chosen == side:
        return found
    return torch.nn.functional.interpolate(found[None], size=(side, side), mode="bilinear", align_corners=False)[0]


def split_words(prompt: str, base_prompt: str, edit_word: str = "") -> tuple[list[str], list[str]]:
    """The words of the edit and those of the object, lower case: what the prompt adds to the base's, and the rest.

    >>> split_words("a cat with a crown", "a cat")
    (['crown'], ['cat'])

    Args:
        edit_word: names the edit's word, in place of the difference.

    Raises:
        UserError: no word is left for the edit, or `edit_word` is not in the prompt.
    """
    words, known = (list(dict.fromkeys(re.findall(r"[^\W_]+", text.lower()))) for text in (prompt, base_prompt))
    content = [word for word in words if word not in _EMPTY_WORDS]
    if edit_word and edit_word.lower() not in words:
        raise UserError(f"edit_word = {edit_word!r}: is not in the prompt {prompt!r}; name one of {', '.join(words)}")
    edit = [edit_word.lower()] if edit_word else [word for word in content if word not in known]
    if not edit or (not edit_word and not known):
        raise UserError(
            f"the prompt {prompt!r} and the base prompt {base_prompt!r} do not tell which word is the edit's; name one "
            "with edit_word, as in 'voxe {edit_word = \"crown\"}'"
        )
    return edit, [word for word in content if word not in edit]


def token_places(tokenizer: Any, text: str, words: Sequence[str]) -> list[int]:
    """Where the tokens of some words stand in a tokenized text, without repeats; words that are not there count not."""
    ids = tokenizer(text).input_ids
    places: list[int] = []
    for word in words:
        own = tokenizer(word, add_special_tokens=False).input_ids
        starts = [at for at in range(len(ids) - len(own) + 1) if own and ids[at : at + len(own)] == own]
        places += [at + step for at in starts for step in range(len(own))]
    return sorted(set(places))
