"""A network that is told where the part may be, by the UNet itself, called by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_local_guidance import SIDE, gradient_of, left_half, load, noisy_latents, pipeline_of, views_for
from tiny_pipelines import save_pipeline
from torch import Tensor

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews

PROMPT, PART = "a horse with wings", "a horse with a crown"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pipeline("inpaint", tmp_path_factory.mktemp("told") / "model", {"sees_region": True})


def seen_base(guidance: DiffusionGuidance, views: GuidanceViews) -> Tensor:
    """As InstructPix2Pix gives it to its UNet: as the encoder has it, without the scaling factor."""
    return views.base[:, :4] / pipeline_of(guidance.components.folder).vae.config.scaling_factor


def noise_seen(guidance: DiffusionGuidance, views: GuidanceViews, region: Tensor, text: str, scale: float) -> Tensor:
    """e_hat of the two passes, the base whole in both: image guidance of 1 needs no third."""
    z_t, t, _, _ = noisy_latents(guidance, views)
    unet = pipeline_of(guidance.components.folder).unet
    inputs = torch.cat([z_t, region, seen_base(guidance, views)], dim=1)
    with torch.no_grad():
        free, seen = (unet(inputs, t, guidance.texts.embed([words] * 2)).sample for words in ("", text))
    return free + scale * (seen - free)


def test_the_gradient_by_hand(folder: Path) -> None:
    guidance = load(folder, guidance_scale=7.5, image_guidance_scale=1.0)
    assert guidance.has_image_pass and guidance.needs_base and not guidance.inpaints and guidance.region_size == SIDE
    guidance.set_prompt(PROMPT)
    views, region = views_for(guidance), left_half(share=0.4)
    _, _, noise, alpha_bar = noisy_latents(guidance, views)
    for told, regions in ((region, {"wings": region}), (torch.zeros_like(region), {})):
        seen = noise_seen(guidance, views, told, PROMPT, 7.5)
        expected = (1 - alpha_bar) * (seen - noise) / 2
        got = gradient_of(guidance, replace(views, regions=regions))[:, :4]
        assert (got - expected).abs().max() < 1e-4 * expected.abs().max()


def test_several_parts_are_seen_together_and_each_with_its_text_alone(folder: Path) -> None:
    guidance = load(folder, guidance_scale=7.5, image_guidance_scale=1.0)
    guidance.set_prompt(PROMPT)
    guidance.set_part_prompts({"crown": (PART, "")})
    crown, wings = left_half(share=0.5), 1 - left_half()
    views = replace(views_for(guidance), regions={"crown": crown, "wings": wings})
    _, _, noise, alpha_bar = noisy_latents(guidance, views)
    both, alone = (noise_seen(guidance, views, told, PROMPT, 7.5) for told in (crown + wings, crown))
    own = noise_seen(guidance, views, crown, PART, 7.5)
    assert (both - alone).abs().max() > 1e-3
    # The pass without text reads the same in the part's place, and is not asked again there.
    z_t, t, _, _ = noisy_latents(guidance, views)
    condition = torch.cat([crown + wings, seen_base(guidance, views)], dim=1)
    texts = {"text": guidance.texts.embed([PROMPT] * 2), "image": guidance.texts.embed([""] * 2)}
    with torch.no_grad():
        whole = guidance.predict_noise(z_t, t, texts, Beside(condition))
        there = guidance.predict_noise(
            z_t, t, {"text": guidance.texts.embed([PART] * 2)}, Beside(condition).told(crown)
        )
    text = whole["text"] + crown * (there["text"] - whole["text"])
    seen = whole["image"] + 7.5 * (text - whole["image"])
    expected = (1 - alpha_bar) * (seen - noise) / 2
    got = gradient_of(guidance, views)[:, :4]
    assert (got - expected).abs().max() < 1e-4 * expected.abs().max()
    assert (own - seen).abs().max() > 1e-3


def test_the_bases_latents_alone_are_a_region_that_is_not_told(folder: Path) -> None:
    guidance = load(folder)
    guidance.set_prompt(PROMPT)
    views = views_for(guidance)
    z_t, t, _, _ = noisy_latents(guidance, views)
    base, texts = views.base[:, :4], {"text": guidance.texts.embed([PROMPT] * 2)}
    with torch.no_grad():
        alone, zeros = (
            guidance.predict_noise(z_t, t, texts, Beside(condition))["text"]
            for condition in (base, torch.cat([torch.zeros_like(base[:, :1]), base], dim=1))
        )
    assert torch.equal(alone, zeros)


def test_channels_that_do_not_fit_are_named(tmp_path: Path) -> None:
    folder = save_pipeline("ip2p", tmp_path / "model", {"sees_region": True})
    with pytest.raises(UserError, match=r"fd_mitsuba.json: sees_region but the UNet has 8 input channels, not 9"):
        load(folder)
    (folder / "fd_mitsuba.json").write_text(json.dumps({"predicts": "difference"}), encoding="utf-8")
    with pytest.raises(UserError, match="or 9 with sees_region"):
        load(folder)
