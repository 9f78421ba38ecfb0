"""The built-in prior's networks, in the layout of an InstructPix2Pix pipeline."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import torch
from diffusers import DDIMScheduler, UNet2DConditionModel
from safetensors.torch import load_file
from tokenizers import Tokenizer, decoders, models, normalizers, pre_tokenizers, processors
from transformers import CLIPTextConfig, CLIPTextModel, PreTrainedTokenizerFast

from fd_mitsuba.prior.data.captions import vocabulary

TEXT_WIDTH = 128
TEXT_LENGTH = 24
LATENT_SIZE = 64
ATTENTION_CELLS = (16, 8)
"""Sides of the levels with attention: above 16 x 16 cells it is what costs."""


def build_tokenizer(words: Sequence[str] | None = None) -> PreTrainedTokenizerFast:
    """A CLIP-format byte-pair tokenizer in which every word is a single token, always the same one.

    Args:
        words: of the captions; None: the coarse prior's.
    """
    begin, end, suffix = "<|startoftext|>", "<|endoftext|>", "</w>"
    letters = list("abcdefghijklmnopqrstuvwxyz0123456789,.-'")
    merges = word_merges([*(vocabulary() if words is None else words), ","], suffix)
    tokens = [begin, end, *letters, *(letter + suffix for letter in letters), *("".join(pair) for pair in merges)]
    tokenizer = Tokenizer(
        models.BPE(
            vocab={token: index for index, token in enumerate(dict.fromkeys(tokens))},
            merges=merges,
            unk_token=end,
            end_of_word_suffix=suffix,
            fuse_unk=False,
        )
    )
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.WhitespaceSplit(), pre_tokenizers.Split(",", "isolated")]
    )
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{begin} $A {end}",
        special_tokens=[(begin, tokenizer.token_to_id(begin)), (end, tokenizer.token_to_id(end))],
    )
    tokenizer.decoder = decoders.BPEDecoder(suffix=suffix)
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        bos_token=begin,
        eos_token=end,
        pad_token=end,
        unk_token=end,
        model_max_length=TEXT_LENGTH,
    )


def word_merges(words: list[str], suffix: str) -> list[tuple[str, str]]:
    """Byte-pair merges, most frequent pair first and ties by spelling, until every word is one token.

    The trainer of `tokenizers` breaks ties in the order of a hash table, which numbers tokens anew at each build.
    """
    split = [[*word[:-1], word[-1] + suffix] for word in sorted(set(words))]
    merges = []
    while any(len(word) > 1 for word in split):
        counts = Counter(pair for word in split for pair in pairwise(word))
        first, second = best = min(counts, key=lambda pair: (-counts[pair], pair))
        merges.append(best)
        for word in split:
            at = 0
            while at < len(word) - 1:
                if (word[at], word[at + 1]) == best:
                    word[at : at + 2] = [first + second]
                at += 1
    return merges


def load_packed(
    packed: Path,
    modules: torch.nn.ModuleDict,
    tokenizer: PreTrainedTokenizerFast,
    prediction_type: str,
    with_unet: bool = True,
) -> None:
    """Load the weights of a packed pipeline folder into `modules` (`text_encoder`, `unet`).

    Token embeddings go by the token's spelling, so `tokenizer` may know more words than the packed one; new words keep
    the embeddings that they have. Weights that predict v start to predict the clean picture with the other sign: at
    full noise v is minus the clean picture.
    """
    text = load_file(packed / "text_encoder" / "model.safetensors")
    old = PreTrainedTokenizerFast.from_pretrained(str(packed / "tokenizer"), local_files_only=True).get_vocab()
    key = next(name for name in text if name.endswith("token_embedding.weight"))
    embedding = modules["text_encoder"].state_dict()[key].clone()
    for token, index in tokenizer.get_vocab().items():
        if token in old:
            embedding[index] = text[key][old[token]]
    modules["text_encoder"].load_state_dict({**text, key: embedding})
    if not with_unet:
        return
    unet = load_file(packed / "unet" / "diffusion_pytorch_model.safetensors")
    modules["unet"].load_state_dict(unet)
    before = json.loads((packed / "scheduler" / "scheduler_config.json").read_text(encoding="utf-8"))["prediction_type"]
    if {before, prediction_type} == {"v_prediction", "sample"}:
        with torch.no_grad():
            for parameter in modules["unet"].get_submodule("conv_out").parameters():
                parameter.neg_()


def token_numbers(tokenizer: PreTrainedTokenizerFast) -> dict[str, Any]:
    """What a CLIP text config asks of a tokenizer."""
    return {name: getattr(tokenizer, name) for name in ("bos_token_id", "eos_token_id", "pad_token_id")}


def build_text_encoder(tokenizer: PreTrainedTokenizerFast, width: int = TEXT_WIDTH, layers: int = 2) -> CLIPTextModel:
    """A small CLIP text model, trained together with the UNet."""
    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(tokenizer),
            hidden_size=width,
            intermediate_size=4 * width,
            projection_dim=width,
            num_hidden_layers=layers,
            num_attention_heads=4,
            max_position_embeddings=TEXT_LENGTH,
            **token_numbers(tokenizer),
        )
    )


def build_unet(
    channels: tuple[int, ...] = (32, 48, 96, 160),
    text_width: int = TEXT_WIDTH,
    norm_groups: int = 16,
    latent_size: int = LATENT_SIZE,
    input_channels: int = 8,
) -> UNet2DConditionModel:
    """The denoiser: 8 channels in (noisy latent, condition's latent) or 9 (noisy latent, region, condition's latent), 4
    out, attention at 16 and 8 cells a side.
    """
    attends = [latent_size >> level in ATTENTION_CELLS for level in range(len(channels))]
    return UNet2DConditionModel(
        sample_size=latent_size,
        in_channels=input_channels,
        out_channels=4,
        layers_per_block=1,
        block_out_channels=channels,
        down_block_types=tuple("CrossAttnDownBlock2D" if yes else "DownBlock2D" for yes in attends),
        up_block_types=tuple("CrossAttnUpBlock2D" if yes else "UpBlock2D" for yes in reversed(attends)),
        cross_attention_dim=text_width,
        attention_head_dim=4,
        norm_num_groups=norm_groups,
    )


def build_scheduler(prediction_type: str) -> DDIMScheduler:
    """Stable Diffusion's noise schedule."""
    return DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        num_train_timesteps=1000,
        prediction_type=cast(Any, prediction_type),
        clip_sample=False,
        set_alpha_to_one=False,
        timestep_spacing="trailing",
    )


def tokenize(tokenizer: PreTrainedTokenizerFast, texts: list[str]) -> torch.Tensor:
    """Token numbers (B, TEXT_LENGTH), padded."""
    return tokenizer(
        texts, padding="max_length", max_length=TEXT_LENGTH, truncation=True, return_tensors="pt"
    ).input_ids


class TokenRows:
    """`tokenize` for the same captions again and again: each is split once."""

    def __init__(self, tokenizer: PreTrainedTokenizerFast) -> None:
        self._tokenizer = tokenizer
        self._rows: dict[str, torch.Tensor] = {}

    def __call__(self, texts: list[str]) -> torch.Tensor:
        new = list(dict.fromkeys(text for text in texts if text not in self._rows))
        if new:
            self._rows.update(zip(new, tokenize(self._tokenizer, new), strict=True))
        return torch.stack([self._rows[text] for text in texts])
