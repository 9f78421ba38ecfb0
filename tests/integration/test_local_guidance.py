"""Guidance of single places of a picture, on random pipelines of Stable Diffusion's layout, by diffusers' own code."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import diffusers
import pytest
import torch
from tiny_pipelines import save_pipeline
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews

SIDE = 16
"""Of the tiny pipelines' latents."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("pipelines")
    return {kind: save_pipeline(kind, root / kind) for kind in ("sd15", "ip2p")}


def load(folder: Path, **settings: object) -> DiffusionGuidance:
    guidance = DiffusionGuidance.load(GuidanceConfig(model=str(folder), view_prompts=False, **settings))
    guidance.set_prompt("a horse with wings", "blurry")
    return guidance


def views_for(guidance: DiffusionGuidance, phase: str = "coarse", count: int = 2) -> GuidanceViews:
    size, generator = guidance.picture_size(phase), torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(2, count, 3, size, size, generator=generator), dim=2)
    mask = (torch.rand(2, count, 1, size, size, generator=generator) > 0.4).float()
    pictures, base = torch.cat([normals * mask, mask, mask], dim=2)
    return GuidanceViews(pictures.requires_grad_(), base, [0.0] * count, [20.0] * count)


def left_half(count: int = 2, share: float = 1.0) -> Tensor:
    mask = torch.zeros(count, 1, SIDE, SIDE)
    mask[..., : SIDE // 2] = share
    return mask


def gradient_of(guidance: DiffusionGuidance, views: GuidanceViews, phase: str = "coarse") -> Tensor:
    result = guidance.guide(views, 0, 10, phase, seed=3)
    return torch.autograd.grad(result.loss, views.pictures)[0]


def noisy_latents(guidance: DiffusionGuidance, views: GuidanceViews) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """z_t, timesteps, noise and alpha_bar of the coarse phase's first step, from the scheduler's own table."""
    timesteps, noise = guidance._draw(len(views.pictures), 0, 10, "coarse", 3)
    scheduler = diffusers.DDIMScheduler.from_pretrained(guidance.components.folder / "scheduler")
    pictures = views.pictures.detach()
    z = torch.cat([pictures[:, :3], 2 * pictures[:, 3:4] - 1], dim=1)
    alpha_bar = scheduler.alphas_cumprod[timesteps].view(-1, 1, 1, 1)
    return scheduler.add_noise(z, noise, timesteps), timesteps, noise, alpha_bar


def assert_equal_gradients(got: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Relative to the largest; `expected` is with respect to the latents, whose fourth channel is 2 mask - 1."""
    expected = expected.clone()
    expected[:, 3] *= 2
    assert (got[:, :4] - expected).abs().max() < tolerance * expected.abs().max()


# Prompts of parts.


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_noise_of_a_part_is_that_of_its_own_prompt(folders: dict[str, Path], share: float) -> None:
    guidance = load(folders["sd15"], guidance_scale=7.5)
    guidance.set_part_prompts({"hat": ("a crown", "horse"), "none": ("side view", "")})
    views = views_for(guidance)
    views = replace(views, regions={"hat": left_half(share=share), "none": torch.zeros(2, 1, SIDE, SIDE)})
    z_t, t, noise, alpha_bar = noisy_latents(guidance, views)
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(folders["sd15"], safety_checker=None)

    def guided(prompt: str, negative: str) -> Tensor:
        text, plain = pipeline.encode_prompt([prompt] * 2, "cpu", 1, True, [negative] * 2)
        with torch.no_grad():
            e_text, e_plain = (pipeline.unet(z_t, t, states).sample for states in (text, plain))
        return e_plain + 7.5 * (e_text - e_plain)

    mask = left_half(share=share)
    seen = (1 - mask) * guided("a horse with wings", "blurry") + mask * guided("a crown", "horse")
    assert_equal_gradients(gradient_of(guidance, views), (1 - alpha_bar) * (seen - noise) / 2)


def test_a_part_reads_the_scenes_negative_prompt_where_it_has_none(folders: dict[str, Path]) -> None:
    guidance = load(folders["ip2p"], guidance_scale=7.5, image_guidance_scale=1.5)
    views = replace(views_for(guidance), regions={"hat": left_half()})
    gradients = []
    for negative in ("", "blurry", "horse"):
        guidance.set_part_prompts({"hat": ("a crown", negative)})
        gradients.append(gradient_of(guidance, views))
    assert gradients[0].equal(gradients[1]) and not gradients[0].equal(gradients[2])
    guidance.set_part_prompts({})
    assert guidance.region_size is None and not gradient_of(guidance, views).equal(gradients[0])


def test_views_that_do_not_say_where_the_part_is_are_refused(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    guidance.set_part_prompts({"hat": ("a crown", "")})
    assert guidance.region_size == SIDE
    with pytest.raises(ValueError, match="part 'hat'"):
        gradient_of(guidance, views_for(guidance))
