"""The built-in prior's networks, in the layout of an InstructPix2Pix pipeline."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from diffusers import DDIMScheduler, UNet2DConditionModel
from safetensors.torch import load_file
from tokenizers import Tokenizer, decoders, models, normalizers, pre_tokenizers, processors, trainers
from transformers import CLIPTextConfig, CLIPTextModel, PreTrainedTokenizerFast

from fd_mitsuba.prior.captions import AZIMUTH_WORDS, CLOSEUP_WORD, vocabulary

TEXT_WIDTH = 128
TEXT_LENGTH = 24
LATENT_SIZE = 64


def build_tokenizer() -> PreTrainedTokenizerFast:
    """A CLIP-format byte-pair tokenizer in which every word of the captions is a single token; see `tokenizer_of`."""
    begin, end = "<|startoftext|>", "<|endoftext|>"
    tokenizer = Tokenizer(models.BPE(unk_token=end, end_of_word_suffix="</w>", fuse_unk=False))
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.WhitespaceSplit(), pre_tokenizers.Split(",", "isolated")]
    )
    trainer = trainers.BpeTrainer(
        vocab_size=20000,
        min_frequency=1,
        special_tokens=[begin, end],
        end_of_word_suffix="</w>",
        initial_alphabet=list("abcdefghijklmnopqrstuvwxyz0123456789,.-'"),
        show_progress=False,
    )
    tokenizer.train_from_iterator([*vocabulary(), ","], trainer)
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{begin} $A {end}",
        special_tokens=[(begin, tokenizer.token_to_id(begin)), (end, tokenizer.token_to_id(end))],
    )
    tokenizer.decoder = decoders.BPEDecoder(suffix="</w>")
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        bos_token=begin,
        eos_token=end,
        pad_token=end,
        unk_token=end,
        model_max_length=TEXT_LENGTH,
    )


def tokenizer_of(folder: Path) -> PreTrainedTokenizerFast:
    """The tokenizer that belongs to a training folder: made and saved there at the first call, read at every other.

    The trainer of `tokenizers` numbers short tokens in the order of a hash table, so weights fit one build only.
    """
    path = folder / "tokenizer"
    if not (path / "tokenizer.json").exists():
        build_tokenizer().save_pretrained(path)
    return PreTrainedTokenizerFast.from_pretrained(str(path), local_files_only=True)


def load_packed(packed: Path, modules: torch.nn.ModuleDict) -> None:
    """Load the weights of a packed pipeline folder into `modules` (`text_encoder`, `unet`)."""
    modules["text_encoder"].load_state_dict(load_file(packed / "text_encoder" / "model.safetensors"))
    modules["unet"].load_state_dict(load_file(packed / "unet" / "diffusion_pytorch_model.safetensors"))


def build_text_encoder(tokenizer: PreTrainedTokenizerFast) -> CLIPTextModel:
    """A two-layer CLIP text model, trained together with the UNet."""
    return CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(tokenizer),
            hidden_size=TEXT_WIDTH,
            intermediate_size=4 * TEXT_WIDTH,
            projection_dim=TEXT_WIDTH,
            num_hidden_layers=2,
            num_attention_heads=4,
            max_position_embeddings=TEXT_LENGTH,
            bos_token_id=tokenizer.bos_token_id,
            eos_token_id=tokenizer.eos_token_id,
            pad_token_id=tokenizer.pad_token_id,
        )
    )


def build_unet() -> UNet2DConditionModel:
    """The denoiser: 8 channels in (noisy latent, base latent), 4 out, attention at 16 and 8 cells a side."""
    return UNet2DConditionModel(
        sample_size=LATENT_SIZE,
        in_channels=8,
        out_channels=4,
        layers_per_block=1,
        block_out_channels=(16, 48, 96, 160),
        down_block_types=("DownBlock2D", "DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D", "UpBlock2D"),
        cross_attention_dim=TEXT_WIDTH,
        attention_head_dim=4,
        norm_num_groups=16,
    )


def build_scheduler() -> DDIMScheduler:
    """Stable Diffusion's noise schedule with v-prediction."""
    return DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        num_train_timesteps=1000,
        prediction_type="v_prediction",
        clip_sample=False,
        set_alpha_to_one=False,
        timestep_spacing="trailing",
    )


def conventions() -> dict:
    """What the weights were trained with: written as `fd_mitsuba.json` beside `model_index.json`."""
    return {
        "view_grid": 2,
        "normal_space": "camera",
        "needs_base": True,
        "prompt_template": "{prompt}, {view} {closeup}",
        "view_words": list(AZIMUTH_WORDS),
        "closeup_word": CLOSEUP_WORD,
        "whole_words": True,
    }


def encode_text(tokenizer: PreTrainedTokenizerFast, encoder: CLIPTextModel, texts: list[str]) -> torch.Tensor:
    """Text states (B, TEXT_LENGTH, TEXT_WIDTH); gradients flow."""
    tokens = tokenizer(texts, padding="max_length", max_length=TEXT_LENGTH, truncation=True, return_tensors="pt")
    return encoder(tokens.input_ids).last_hidden_state


def save_conventions(folder: Path) -> None:
    """Write `fd_mitsuba.json`."""
    (folder / "fd_mitsuba.json").write_text(json.dumps(conventions(), indent=2) + "\n", encoding="utf-8")
