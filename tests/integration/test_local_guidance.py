"""Guidance of single places of a picture, on random pipelines of Stable Diffusion's layout, by diffusers' own code."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import diffusers
import pytest
import tiny_guidance
import torch
from tiny_pipelines import save_pipeline
from torch import Tensor

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews

SIDE = 16
"""Of the tiny pipelines' latents."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("pipelines")
    return {kind: save_pipeline(kind, root / kind) for kind in ("sd15", "ip2p", "inpaint")}


@cache
def pipeline_of(folder: Path) -> diffusers.DiffusionPipeline:
    """As diffusers itself loads it."""
    pipeline = diffusers.DiffusionPipeline.from_pretrained(folder, safety_checker=None)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def load(folder: Path, **settings: object) -> DiffusionGuidance:
    return tiny_guidance.load(folder, view_prompts=False, **settings)


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
    timesteps, noise = guidance.draws.of_step(len(views.pictures), 0, 10, "coarse", 3)
    scheduler = diffusers.DDIMScheduler.from_pretrained(guidance.components.folder / "scheduler")
    z = views.pictures.detach()[:, :4]
    alpha_bar = scheduler.alphas_cumprod[timesteps].view(-1, 1, 1, 1)
    return scheduler.add_noise(z, noise, timesteps), timesteps, noise, alpha_bar


def assert_equal_gradients(got: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Relative to the largest; the latents of the coarse phase are the first four channels themselves."""
    assert (got[:, :4] - expected).abs().max() < tolerance * expected.abs().max()


# Prompts of parts.


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_noise_of_a_part_is_that_of_its_own_prompt(folders: dict[str, Path], share: float) -> None:
    guidance = load(folders["sd15"], guidance_scale=7.5)
    guidance.set_part_prompts({"hat": ("a crown", "horse"), "none": ("side view", "")})
    views = views_for(guidance)
    views = replace(views, regions={"hat": left_half(share=share), "none": torch.zeros(2, 1, SIDE, SIDE)})
    z_t, t, noise, alpha_bar = noisy_latents(guidance, views)
    pipeline = pipeline_of(folders["sd15"])

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


# Inpainting models.


def test_an_inpainting_step_equals_the_pipelines_own(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Which value of the mask means "paint", what stands in the hole, how its latents are scaled: one whole step."""
    guidance = load(folders["inpaint"], guidance_scale=7.5, mask_margin=0)
    views = replace(views_for(guidance, "refined", 1), regions={"hat": left_half(1, 0.3)})
    pipeline = pipeline_of(folders["inpaint"])
    pipeline.scheduler = diffusers.DDIMScheduler.from_config(pipeline.scheduler.config, clip_sample=False)
    encode = pipeline.vae.encode  # its mean: the pipeline would draw a sample
    monkeypatch.setattr(
        pipeline.vae, "encode", lambda picture: SimpleNamespace(latents=encode(picture).latent_dist.mean)
    )
    z_t = torch.randn(1, 4, SIDE, SIDE, generator=torch.Generator().manual_seed(5))
    pipeline.scheduler.set_timesteps(1)
    t = pipeline.scheduler.timesteps
    full = torch.nn.functional.interpolate(left_half(1), size=128)
    result = pipeline(
        "a horse with wings",
        image=(views.base[:, :3] + views.base[:, 3:4]) / 2,
        mask_image=full,
        num_inference_steps=1,
        guidance_scale=7.5,
        negative_prompt="blurry",
        latents=z_t,
        strength=1.0,
        height=128,
        width=128,
        output_type="latent",
    ).images
    texts = {"text": guidance.texts.embed(["a horse with wings"]), "plain": guidance.texts.embed(["blurry"])}
    condition = guidance.conditions.seen_around(views.base, guidance.conditions.holes(views), "refined")
    with torch.no_grad():
        seen = guidance.predict_noise(z_t, t, texts, Beside(condition))
    noise = seen["plain"] + 7.5 * (seen["text"] - seen["plain"])
    torch.testing.assert_close(result, pipeline.scheduler.step(noise, t[0], z_t).prev_sample, rtol=1e-4, atol=1e-4)


def test_the_gradient_of_an_inpainting_model_by_hand(folders: dict[str, Path]) -> None:
    guidance = load(folders["inpaint"], guidance_scale=7.5, mask_margin=1)
    views = replace(views_for(guidance), regions={"hat": left_half(share=0.2)})
    z_t, t, noise, alpha_bar = noisy_latents(guidance, views)
    pipeline = pipeline_of(folders["inpaint"])
    hole = torch.zeros(2, 1, SIDE, SIDE)
    hole[..., : SIDE // 2 + 1] = 1
    around = views.base[:, :4] * (1 - hole)
    states = pipeline.encode_prompt(["a horse with wings"] * 2, "cpu", 1, True, ["blurry"] * 2)
    with torch.no_grad():
        e = [pipeline.unet(torch.cat([z_t, hole, around], dim=1), t, text).sample for text in states]
    seen = e[1] + 7.5 * (e[0] - e[1])
    assert_equal_gradients(gradient_of(guidance, views), (1 - alpha_bar) * (seen - noise) / 2)


def test_what_lies_in_the_hole_is_not_seen(folders: dict[str, Path]) -> None:
    """In all three phases; in the appearance stage the part itself is hidden, too."""
    guidance = load(folders["inpaint"], mask_margin=0)
    for phase in ("coarse", "refined"):
        views = replace(views_for(guidance, phase, 1), regions={"hat": left_half(1)})
        other = views.base.clone()
        other[..., : other.shape[-1] // 2] *= 0.5
        assert gradient_of(guidance, views, phase).equal(gradient_of(guidance, replace(views, base=other), phase))
        other[..., other.shape[-1] // 2 :] *= 0.5
        assert not gradient_of(guidance, views, phase).equal(gradient_of(guidance, replace(views, base=other), phase))

    colours, clay = torch.rand(2, 1, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    part = torch.zeros(1, 1, 64, 64)
    part[..., 32:48] = 1
    lit = AppearanceViews(colours.requires_grad_(), clay, part, part, part, [0.0], [0.0], regions={"hat": left_half(1)})
    other = clay.clone()
    other[..., :48] = 0
    results = [guidance.guide_appearance(replace(lit, condition=seen), 0, 3, 7) for seen in (clay, other, clay * 0)]
    first, second, third = (torch.autograd.grad(result.loss, colours)[0] for result in results)
    assert first.equal(second) and not first.equal(third)


def test_an_inpainting_model_without_a_mask_is_one_line(folders: dict[str, Path]) -> None:
    guidance = load(folders["inpaint"])
    assert guidance.needs_base and guidance.region_size == SIDE
    with pytest.raises(UserError, match="inpainting model .* told by a mask .* give GuidanceViews.regions"):
        gradient_of(guidance, views_for(guidance))


# Perp-Neg.


@pytest.mark.parametrize("kind", ["sd15", "ip2p"])
def test_perp_neg_by_hand(folders: dict[str, Path], kind: str) -> None:
    """e(free) + w (d - 0.7 (d' - (d' d / d d) d)) with d, d' the two prompts' noises less that of the empty text."""
    guidance = load(folders[kind], guidance_scale=7.5, image_guidance_scale=1.5, perp_neg=0.7)
    views = views_for(guidance)
    z_t, t, noise, alpha_bar = noisy_latents(guidance, views)
    pipeline = pipeline_of(folders["sd15"])
    base = views.base[:, :4] / 0.18215
    unet = guidance.components.unet

    def seen(text: str, image: float = 1.0) -> Tensor:
        states = pipeline.encode_prompt([text] * 2, "cpu", 1, False)[0]
        inputs = z_t if kind == "sd15" else torch.cat([z_t, image * base], dim=1)
        with torch.no_grad():
            return unet(inputs, t, states).sample

    free = seen("")
    wanted, unwanted = seen("a horse with wings") - free, seen("blurry") - free
    rows = zip(wanted.double(), unwanted.double(), strict=True)
    across = torch.stack([u - (u.flatten() @ w.flatten()) / (w.flatten() @ w.flatten()) * w for w, u in rows]).float()
    expected = free + 7.5 * (wanted - 0.7 * across) - noise
    if kind == "ip2p":
        expected = expected + (1.5 - 1) * (free - seen("", 0.0))
    assert_equal_gradients(gradient_of(guidance, views), (1 - alpha_bar) * expected / 2)


def test_perp_neg_of_what_the_prompt_wants_anyway_takes_nothing_away(folders: dict[str, Path]) -> None:
    same, none = load(folders["sd15"], perp_neg=0.7, guidance_scale=7.5), load(folders["sd15"], guidance_scale=7.5)
    same.set_prompt("a horse", "a horse")
    none.set_prompt("a horse", "")
    views = views_for(same)
    got, expected = gradient_of(same, views), gradient_of(none, views)
    assert (got - expected).abs().max() < 1e-4 * expected.abs().max()


def test_perp_neg_where_it_has_no_place_is_one_line(folders: dict[str, Path]) -> None:
    with pytest.raises(UserError, match=r"guidance.perp_neg = 0.5: csd makes no use of it"):
        load(folders["sd15"], perp_neg=0.5, variant="csd")
