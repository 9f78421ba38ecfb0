"""From a training checkpoint to the folder that ships: fp16 safetensors in Diffusers' layout, with hashes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import diffusers
import torch

from fd_mitsuba.guidance.builtin import SUMS_NAME, write_hashes
from fd_mitsuba.prior.training import clip_train
from fd_mitsuba.prior.training.kinds import GEOMETRY, kind_named
from fd_mitsuba.prior.training.model import build_scheduler, build_tokenizer
from fd_mitsuba.prior.training.training_folder import require_same_shapes


def pack(checkpoint: Path, folder: Path) -> None:
    """Write the averaged weights of a checkpoint as an InstructPix2Pix-layout pipeline, an evaluator's as a CLIP model.

    A prior whose training was no further than its small steps is written as one of pictures of half the size.

    Args:
        checkpoint: `checkpoint.pt` of `training.train.train` or `clip_train.train_evaluator`; it says which kind it is.
        folder: created; existing files are replaced.

    Raises:
        UserError: weights of another version's networks.
    """
    state = torch.load(checkpoint, weights_only=True)
    if state.get("kind") == clip_train.KIND:
        clip_train.pack_evaluator(state, folder)
        return
    kind = kind_named(state.get("kind", GEOMETRY.name))
    tokenizer = build_tokenizer(kind.catalogue.vocabulary)
    modules: Any = kind.build_modules(tokenizer)
    if "step" in state and state["step"] <= state.get("small_steps", 0):  # all that it has seen
        modules["unet"].register_to_config(sample_size=kind.view_size)
    require_same_shapes(checkpoint, state["average"], modules)
    missing = modules.load_state_dict(state["average"], strict=False).missing_keys
    if any("position_ids" not in key for key in missing):
        raise ValueError(f"{checkpoint}: lacks {missing}")
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("unet", "text_encoder"):
        network: Any = modules[name].half()
        network.save_pretrained(folder / name)
    kind.build_vae().half().save_pretrained(folder / "vae")
    tokenizer.save_pretrained(folder / "tokenizer")
    build_scheduler(kind.prediction).save_pretrained(folder / "scheduler")
    index = {
        "_class_name": "StableDiffusionInstructPix2PixPipeline",
        "_diffusers_version": diffusers.__version__,
        "feature_extractor": [None, None],
        "image_encoder": [None, None],
        "requires_safety_checker": False,
        "safety_checker": [None, None],
        "scheduler": ["diffusers", "DDIMScheduler"],
        "text_encoder": ["transformers", "CLIPTextModel"],
        "tokenizer": ["transformers", "PreTrainedTokenizerFast"],
        "unet": ["diffusers", "UNet2DConditionModel"],
        "vae": ["diffusers", "AutoencoderTiny"],
    }
    (folder / "model_index.json").write_text(json.dumps(index, indent=2) + "\n", encoding="utf-8")
    kind.save_conventions(folder)
    write_hashes(folder, (p for p in folder.rglob("*") if p.is_file() and p.name != SUMS_NAME))
