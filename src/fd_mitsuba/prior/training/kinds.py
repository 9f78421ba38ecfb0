"""The built-in priors: what each is trained on, how large its networks are, and how it wants to be fed."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderTiny
from transformers import PreTrainedTokenizerFast

from fd_mitsuba.errors import UserError
from fd_mitsuba.prior.data.captions import AZIMUTH_WORDS, CLOSEUP_WORD
from fd_mitsuba.prior.data.catalogue import COARSE, FINE, Catalogue
from fd_mitsuba.prior.pictures.colour_corpus import make_colour_pairs
from fd_mitsuba.prior.pictures.corpus import Pair, make_pairs
from fd_mitsuba.prior.pictures.fine_colour_corpus import make_fine_colour_pairs
from fd_mitsuba.prior.pictures.fine_corpus import make_fine_pairs, make_wide_pairs
from fd_mitsuba.prior.training.model import build_text_encoder, build_unet
from fd_mitsuba.prior.training.vae import build_vae
from fd_mitsuba.prior.training.vae_colour import build_colour_vae

_CONVENTIONS: dict[str, Any] = {
    "view_grid": 2,
    "needs_base": True,
    "prompt_template": "{prompt}, {view} {closeup}",
    "view_words": list(AZIMUTH_WORDS),
    "closeup_word": CLOSEUP_WORD,
    "whole_words": True,
    "vocabulary": COARSE.word_lists,
}


@dataclass(frozen=True)
class Kind:
    """A prior of one sort of picture.

    Attributes:
        name: `geometry`, `geometry_wide`, `geometry_fine`, `appearance` or `appearance_fine`.
        catalogue: bodies, parts and words.
        view_size: side in pixels of one of a mosaic's four views; the latents are twice as wide.
        make_pairs: (body, parts, seed) -> training pairs.
        channels: of the UNet's levels, the finest first.
        norm_groups: of the UNet's group norms. As many as channels would take each channel's mean and size away, which
            normals can spare and colours cannot.
        text_width, text_layers: of the text encoder.
        learning_rate: at its highest, after the warm-up. At 1.5e-3 random weights never learn what colour words mean.
        part_weight: extra loss weight of the part's pixels: they are few, and the rest is a copy.
        copy_weight: weight of the absolute error where the part is not, beside the squared one: small errors of a copy
            hardly count when squared, and where a part is unlikely the base itself is the better guess than their mean.
        tint_weight: extra loss weight of colour as against brightness, which four correlated channels share.
        time_power: t = 1000 u^time_power for uniform u; below 1 draws high noise more often.
        fresh_pairs: new training pairs a step.
        steps: length of the schedule that makes such a prior from random weights.
        small_steps: first steps on pictures of half the size, a quarter of the cost: enough to learn what words mean.
        masked_noise: share of the pictures with noise on the part alone, as guidance with `mask_guidance` makes them.
        rounded: share of the pictures whose part is rounded off under the noise, see `pictures.rounding`.
        prediction: what the UNet says of a noisy picture, as Diffusers names it: `v_prediction`, or `sample`, the clean
            one, which is the easiest to learn where most of it is a copy of the condition.
        build_vae: the autoencoder that goes into the folder.
        conventions: written as `fd_mitsuba.json` beside `model_index.json`.
    """

    name: str
    catalogue: Catalogue
    view_size: int
    make_pairs: Callable[[str, list[str | None], int], Sequence[Pair]]
    channels: tuple[int, ...]
    norm_groups: int
    text_width: int
    text_layers: int
    learning_rate: float
    part_weight: float
    copy_weight: float
    tint_weight: float
    time_power: float
    fresh_pairs: int
    steps: int
    small_steps: int
    masked_noise: float
    rounded: float
    prediction: str
    build_vae: Callable[[], AutoencoderTiny]
    conventions: dict[str, Any]

    @property
    def input_channels(self) -> int:
        """Of the UNet: the noisy latents', the condition's, and where it is told it the region's."""
        return 9 if self.conventions.get("sees_region") else 8

    @property
    def difference(self) -> bool:
        """Whether the UNet says only what must be added to the condition."""
        return self.conventions.get("predicts") == "difference"

    def build_modules(self, tokenizer: PreTrainedTokenizerFast) -> torch.nn.ModuleDict:
        """Fresh `text_encoder` and `unet`."""
        encoder = build_text_encoder(tokenizer, self.text_width, self.text_layers)
        return torch.nn.ModuleDict(
            {
                "text_encoder": encoder,
                "unet": build_unet(
                    self.channels, self.text_width, self.norm_groups, 2 * self.view_size, self.input_channels
                ),
            }
        )

    def save_conventions(self, folder: Path) -> None:
        """Write `fd_mitsuba.json`."""
        (folder / "fd_mitsuba.json").write_text(json.dumps(self.conventions, indent=2) + "\n", encoding="utf-8")


GEOMETRY = Kind(
    name="geometry",
    catalogue=COARSE,
    view_size=32,
    make_pairs=make_pairs,
    channels=(32, 48, 96, 160),
    norm_groups=1,
    text_width=128,
    text_layers=2,
    learning_rate=6e-4,
    part_weight=4.0,
    copy_weight=0.1,
    tint_weight=0.0,
    time_power=0.75,
    fresh_pairs=4,
    steps=16000,
    small_steps=1000,
    masked_noise=0.0,
    rounded=0.5,
    prediction="sample",
    build_vae=build_vae,
    conventions={
        **_CONVENTIONS,
        "normal_space": "camera",
        "predicts": "difference",
        "sees_region": True,
        "draft_scale": 2.0,
    },
)
GEOMETRY_FINE = replace(
    GEOMETRY,
    name="geometry_fine",
    catalogue=FINE,
    view_size=64,
    make_pairs=make_fine_pairs,
    channels=(32, 32, 48, 96, 160),
    fresh_pairs=6,
    rounded=0.0,
    conventions={**GEOMETRY.conventions, "vocabulary": FINE.word_lists},
)
GEOMETRY_WIDE = replace(
    GEOMETRY,
    name="geometry_wide",
    catalogue=FINE,
    make_pairs=make_wide_pairs,
    fresh_pairs=6,
    conventions={**GEOMETRY.conventions, "vocabulary": FINE.word_lists},
)
APPEARANCE = Kind(
    name="appearance",
    catalogue=COARSE,
    view_size=32,
    make_pairs=make_colour_pairs,
    channels=(16, 32, 64, 96),
    norm_groups=1,
    text_width=96,
    text_layers=1,
    learning_rate=6e-4,
    part_weight=8.0,
    copy_weight=0.0,
    tint_weight=4.0,
    time_power=0.6,
    fresh_pairs=4,
    steps=10000,
    small_steps=3500,
    masked_noise=0.9,
    rounded=0.0,
    prediction="sample",
    build_vae=build_colour_vae,
    conventions={**_CONVENTIONS, "condition": "clay", "latents": "area_mean_shine", "background": "black"},
)
APPEARANCE_FINE = replace(
    APPEARANCE,
    name="appearance_fine",
    catalogue=FINE,
    view_size=64,
    make_pairs=make_fine_colour_pairs,
    channels=(16, 32, 48, 64, 96),
    steps=10000,
    fresh_pairs=6,
    conventions={**APPEARANCE.conventions, "vocabulary": FINE.word_lists},
)
KINDS = {kind.name: kind for kind in (GEOMETRY, GEOMETRY_WIDE, GEOMETRY_FINE, APPEARANCE, APPEARANCE_FINE)}


def kind_named(name: str) -> Kind:
    """The kind of that name. Raises UserError for an unknown one."""
    if name not in KINDS:
        raise UserError(f"--kind {name}: no such prior; known: {', '.join(KINDS)}")
    return KINDS[name]
