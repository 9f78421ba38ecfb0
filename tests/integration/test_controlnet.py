"""A random ControlNet on a random model of Stable Diffusion's layout, and a run with all that makes edits local."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import diffusers
import numpy as np
import pytest
import torch
from conftest import BASE, INTEGRATOR, LIGHT, PART, REGION, write_ply
from test_whole_run import SETTINGS
from tiny_pipelines import build_pipeline, save_pipeline

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews
from fd_mitsuba.training.record import read_metrics


def controlnet() -> diffusers.ControlNetModel:
    """Of the pipeline's UNet; its last convolutions, which start as zeros, are random."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        unet = build_pipeline("sd15").unet
        made = diffusers.ControlNetModel.from_unet(unet, conditioning_embedding_out_channels=(4, 8, 8, 8))
        for block in (*made.controlnet_down_blocks, made.controlnet_mid_block, made.controlnet_cond_embedding.conv_out):
            torch.nn.init.normal_(block.weight, std=0.3)
    return made.eval()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("control")
    save_pipeline("sd15", folder / "sd15")
    controlnet().save_pretrained(folder / "control")
    return folder


def load(root: Path, **settings: object) -> DiffusionGuidance:
    settings = {"controlnet": str(root / "control"), "view_prompts": False, **settings}
    config = GuidanceConfig(model=str(root / "sd15"), **settings)
    guidance = DiffusionGuidance.load(config, appearance=AppearanceConfig(mask_guidance=False, guidance_scale=7.5))
    guidance.set_prompt("a horse with wings", "blurry")
    return guidance


def lit_views(size: int = 128) -> AppearanceViews:
    pictures, control = torch.rand(2, 2, 3, size, size, generator=torch.Generator().manual_seed(0))
    whole = torch.ones(2, 1, size, size)
    return AppearanceViews(pictures.requires_grad_(), None, whole, whole, whole, [0.0] * 2, [0.0] * 2, control=control)


@pytest.fixture(scope="module")
def pipeline(root: Path) -> diffusers.StableDiffusionControlNetPipeline:
    loaded = diffusers.ControlNetModel.from_pretrained(root / "control")
    made = diffusers.StableDiffusionControlNetPipeline.from_pretrained(
        root / "sd15", controlnet=loaded, safety_checker=None
    )
    made.scheduler = diffusers.DDIMScheduler.from_config(made.scheduler.config, clip_sample=False)
    made.set_progress_bar_config(disable=True)
    return made


def test_a_step_with_a_controlnet_equals_the_pipelines_own(
    root: Path, pipeline: diffusers.StableDiffusionControlNetPipeline
) -> None:
    guidance, views = load(root, controlnet_scale=0.6), lit_views()
    z_t = torch.randn(1, 4, 16, 16, generator=torch.Generator().manual_seed(5))
    pipeline.scheduler.set_timesteps(1)
    t = pipeline.scheduler.timesteps
    result = pipeline(
        "a horse with wings",
        image=views.control[:1],
        num_inference_steps=1,
        guidance_scale=7.5,
        negative_prompt="blurry",
        latents=z_t,
        controlnet_conditioning_scale=0.6,
        output_type="latent",
    ).images
    texts = {"text": guidance.texts.embed(["a horse with wings"]), "plain": guidance.texts.embed(["blurry"])}
    with torch.no_grad():
        with_it, without = (
            guidance.predict_noise(z_t, t, texts, Beside(control=seen)) for seen in (views.control[:1], None)
        )
    noise = with_it["plain"] + 7.5 * (with_it["text"] - with_it["plain"])
    torch.testing.assert_close(result, pipeline.scheduler.step(noise, t[0], z_t).prev_sample, rtol=1e-4, atol=1e-4)
    assert not torch.allclose(with_it["text"], without["text"], atol=1e-2)


def test_the_gradient_with_a_controlnet_by_hand(
    root: Path, pipeline: diffusers.StableDiffusionControlNetPipeline
) -> None:
    guidance, views = load(root), lit_views()
    t, noise = guidance.draws.of_step(2, 0, 10, "appearance", 3)
    z = guidance.encode(views.pictures, "appearance")
    z_t = pipeline.scheduler.add_noise(z.detach(), noise, t)
    seen = []
    with torch.no_grad():
        for states in pipeline.encode_prompt(["a horse with wings"] * 2, "cpu", 1, True, ["blurry"] * 2):
            down, middle = pipeline.controlnet(z_t, t, states, views.control, return_dict=False)
            seen.append(
                pipeline.unet(
                    z_t, t, states, down_block_additional_residuals=down, mid_block_additional_residual=middle
                ).sample
            )
    w = 1 / (1 - pipeline.scheduler.alphas_cumprod[t].view(-1, 1, 1, 1))
    expected = torch.autograd.grad(z, views.pictures, w * (seen[1] + 7.5 * (seen[0] - seen[1]) - noise) / 2)[0]
    got = torch.autograd.grad(guidance.guide_appearance(views, 0, 10, 3).loss, views.pictures)[0]
    assert (got - expected).abs().max() < 1e-4 * expected.abs().max()
    with pytest.raises(ValueError, match="needs the surface's depth"):
        guidance.guide_appearance(replace(views, control=None), 0, 10, 3)


def edit(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "whole pipeline": (lambda f: (f / "model_index.json").write_text("{}"), "is a whole pipeline; set"),
    "no config": (lambda f: (f / "config.json").unlink(), "is no ControlNet"),
    "a unet": (lambda f: edit(f / "config.json", _class_name="UNet2DConditionModel"), "not a ControlNetModel"),
    "other text width": (lambda f: edit(f / "config.json", cross_attention_dim=64), "cross_attention_dim is 64"),
    "other widths": (lambda f: edit(f / "config.json", block_out_channels=[32, 64]), "made for the model"),
    "four channels": (
        lambda f: edit(f / "config.json", conditioning_channels=4),
        "not 4 of latents and 3 of a picture",
    ),
    "no weights": (lambda f: (f / "diffusion_pytorch_model.safetensors").unlink(), "safetensors: missing"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_controlnet_that_does_not_fit_is_one_line(root: Path, tmp_path: Path, case: str) -> None:
    spoil, expected = BAD[case]
    controlnet().save_pretrained(tmp_path / "bad")
    spoil(tmp_path / "bad")
    with pytest.raises(UserError) as caught:
        load(root, controlnet=str(tmp_path / "bad"))
    assert expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_run_with_all_that_makes_edits_local(root: Path, animal: tuple[np.ndarray, np.ndarray]) -> None:
    """Three steps of each stage: an inpainting model, a ControlNet, Perp-Neg, and two parts with a prompt each."""
    save_pipeline("inpaint", root / "inpaint")
    write_ply(root / "animal.ply", *animal)
    parts = [
        REGION.replace('id="wing">', f'id="{name}"><string name="part" value="{name}"/>{texts}').replace(
            'y="0.35"', place
        )
        for name, texts, place in (
            ("hat", '<string name="prompt" value="a crown"/>', 'y="0.35"'),
            (
                "tail",
                '<string name="prompt" value="wings"/><string name="negative_prompt" value="a horse"/>',
                'y="0.2"',
            ),
        )
    ]
    words = INTEGRATOR.replace("</integrator>", '<string name="negative_prompt" value="blurry"/></integrator>')
    (root / "scene.xml").write_text(
        "\n".join(['<scene version="3.0.0">', LIGHT, words, BASE, PART, *parts, "</scene>"])
    )
    (root / "tiny.toml").write_text(SETTINGS.replace("steps = 2", "steps = 3"))
    settings = {"model": root / "inpaint", "controlnet": root / "control", "perp_neg": 0.5}
    chosen = [word for key, value in settings.items() for word in ("--set", f"guidance.{key}={value}")]
    line = ["run", root / "scene.xml", "-c", root / "tiny.toml", *chosen, "-o", root / "run", "-q", "-t", "2"]
    assert main([str(word) for word in line]) == 0
    rows = read_metrics(root / "run" / "metrics.jsonl")
    assert [row["phase"] for row in rows] == ["coarse", "coarse", "refined", *["appearance"] * 3]
    assert all(row["loss_sds"] > 0 for row in rows)
    assert {path.name for path in (root / "run" / "export").glob("part_*.ply")} == {"part_hat.ply", "part_tail.ply"}
