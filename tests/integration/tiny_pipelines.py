"""Randomly initialised pipelines with the layer layout of real Stable Diffusion models, narrow enough for a test."""

from __future__ import annotations

import json
from pathlib import Path

import diffusers
import torch
import transformers

WORDS = ("a", "horse", "with", "wings", "front", "side", "back", "view", "crown", "blurry")
UNET_1_5 = dict(
    down_block_types=("CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
    up_block_types=("UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
    layers_per_block=2,
    block_out_channels=(32, 64, 128, 128),
    attention_head_dim=8,
    cross_attention_dim=48,
    sample_size=16,
)
UNET_2_1 = UNET_1_5 | dict(attention_head_dim=[2, 4, 8, 8], cross_attention_dim=64, use_linear_projection=True)
BETAS = dict(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", num_train_timesteps=1000)


def tiny_tokenizer(padding: str = "<|endoftext|>") -> transformers.CLIPTokenizer:
    """A CLIP tokenizer that knows single characters and `WORDS`."""
    symbols = [chr(code) for code in range(33, 127)]
    vocabulary = symbols + [symbol + "</w>" for symbol in symbols]
    merges: list[tuple[str, str]] = []
    for word in WORDS:
        pieces = [*word[:-1], word[-1] + "</w>"]
        while len(pieces) > 1:
            pair = (pieces[0], pieces[1])
            if pair not in merges:
                merges.append(pair)
            pieces = ["".join(pair), *pieces[2:]]
            vocabulary.append(pieces[0])
    vocabulary = list(dict.fromkeys(vocabulary)) + ["<|startoftext|>", "<|endoftext|>"]
    return transformers.CLIPTokenizer(
        vocab={token: index for index, token in enumerate(vocabulary)},
        merges=merges,
        model_max_length=77,
        pad_token=padding,
    )


def tiny_text_encoder(tokenizer: transformers.CLIPTokenizer, **changes: object) -> transformers.CLIPTextModel:
    settings = dict(
        vocab_size=len(tokenizer),
        hidden_size=48,
        intermediate_size=96,
        num_hidden_layers=2,
        num_attention_heads=4,
        max_position_embeddings=77,
        hidden_act="quick_gelu",
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )
    return transformers.CLIPTextModel(transformers.CLIPTextConfig(**(settings | changes))).eval()


def tiny_vae() -> diffusers.AutoencoderKL:
    return diffusers.AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(8, 16, 16, 16),
        layers_per_block=2,
        norm_num_groups=8,
        latent_channels=4,
        sample_size=128,
    )


def build_pipeline(kind: str, seed: int = 0, with_unet: bool = True) -> diffusers.DiffusionPipeline:
    """`sd15` (eps), `sd21` (v, OpenCLIP-like text encoder), `ip2p` (8 channels), `inpaint` (9), `tiny_vae`.

    Args:
        with_unet: else it has none.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        common = dict(safety_checker=None, feature_extractor=None, requires_safety_checker=False)
        if kind == "sd21":
            tokenizer = tiny_tokenizer(padding="!")
            return diffusers.StableDiffusionPipeline(
                vae=tiny_vae(),
                text_encoder=tiny_text_encoder(tokenizer, hidden_size=64, num_hidden_layers=3, hidden_act="gelu"),
                tokenizer=tokenizer,
                unet=diffusers.UNet2DConditionModel(**UNET_2_1) if with_unet else None,
                scheduler=diffusers.DDIMScheduler(
                    **BETAS, prediction_type="v_prediction", steps_offset=1, clip_sample=False, set_alpha_to_one=False
                ),
                **common,
            )
        tokenizer = tiny_tokenizer()
        parts = dict(
            vae=tiny_vae()
            if kind != "tiny_vae"
            else diffusers.AutoencoderTiny(
                encoder_block_out_channels=(8, 8, 8, 8), decoder_block_out_channels=(8, 8, 8, 8)
            ),
            text_encoder=tiny_text_encoder(tokenizer),
            tokenizer=tokenizer,
            unet=diffusers.UNet2DConditionModel(**UNET_1_5, in_channels={"ip2p": 8, "inpaint": 9}.get(kind, 4))
            if with_unet
            else None,
            scheduler=diffusers.PNDMScheduler(**BETAS, skip_prk_steps=True, steps_offset=1),
        )
        if kind == "ip2p":
            return diffusers.StableDiffusionInstructPix2PixPipeline(**parts, **common)
        if kind == "inpaint":
            return diffusers.StableDiffusionInpaintPipeline(**parts, **common)
        return diffusers.StableDiffusionPipeline(**parts, **common)


def save_pipeline(kind: str, folder: Path, conventions: dict[str, object] | None = None) -> Path:
    """The folder that diffusers itself writes, with the conventions, if given, in `fd_mitsuba.json`."""
    build_pipeline(kind).save_pretrained(folder)
    if conventions is not None:
        (folder / "fd_mitsuba.json").write_text(json.dumps(conventions), encoding="utf-8")
    return folder
