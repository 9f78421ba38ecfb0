"""A random IP-Adapter on a random model of Stable Diffusion's layout, against diffusers' own pipeline."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import diffusers
import numpy as np
import pytest
import torch
import transformers
from PIL import Image
from safetensors.torch import load_file, save_file
from tiny_pipelines import save_pipeline

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews

TOKENS, SAID, WIDTH = 4, 24, 48


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, an image encoder, an adapter as its authors' files are, and a picture."""
    folder = tmp_path_factory.mktemp("picture")
    save_pipeline("sd15", folder / "sd15")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        sizes = dict(hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4)
        config = transformers.CLIPVisionConfig(**sizes, image_size=32, patch_size=8, projection_dim=SAID)
        transformers.CLIPVisionModelWithProjection(config).save_pretrained(folder / "encoder")
        tensors = {
            "image_proj.proj.weight": torch.randn(TOKENS * WIDTH, SAID),
            "image_proj.proj.bias": torch.randn(TOKENS * WIDTH),
            "image_proj.norm.weight": torch.ones(WIDTH),
            "image_proj.norm.bias": torch.zeros(WIDTH),
        }
        unet = diffusers.UNet2DConditionModel.from_pretrained(folder / "sd15" / "unet")
        places = [name for name in unet.attn_processors if "attn2" in name]
        for index, name in enumerate(places):
            layer = unet.get_submodule(name.removesuffix(".processor"))
            for key in ("to_k_ip", "to_v_ip"):
                tensors[f"ip_adapter.{2 * index + 1}.{key}.weight"] = torch.randn(layer.to_k.weight.shape) * 0.3
    (folder / "adapter").mkdir()
    save_file(tensors, folder / "adapter" / "ip-adapter.safetensors")
    pixels = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / "picture.png")
    return folder


def settings(root: Path, **changes: object) -> GuidanceConfig:
    chosen = {
        "model": str(root / "sd15"),
        "image_prompt": str(root / "picture.png"),
        "ip_adapter": str(root / "adapter"),
        "ip_adapter_encoder": str(root / "encoder"),
        "view_prompts": False,
    }
    return GuidanceConfig(**(chosen | changes))


def load(root: Path, **changes: object) -> DiffusionGuidance:
    appearance = AppearanceConfig(mask_guidance=False, guidance_scale=7.5)
    guidance = DiffusionGuidance.load(settings(root, **changes), appearance=appearance)
    guidance.set_prompt("a horse with wings", "blurry")
    return guidance


@pytest.fixture(scope="module")
def guidance(root: Path) -> DiffusionGuidance:
    return load(root, image_prompt_scale=0.6)


def test_a_step_with_a_picture_equals_the_pipelines_own(root: Path, guidance: DiffusionGuidance) -> None:
    encoder = transformers.CLIPVisionModelWithProjection.from_pretrained(root / "encoder")
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(
        root / "sd15", safety_checker=None, image_encoder=encoder
    )
    pipeline.load_ip_adapter(str(root / "adapter"), subfolder="", weight_name="ip-adapter.safetensors")
    pipeline.set_ip_adapter_scale(0.6)
    pipeline.scheduler = diffusers.DDIMScheduler.from_config(pipeline.scheduler.config, clip_sample=False)
    pipeline.set_progress_bar_config(disable=True)
    z_t = torch.randn(1, 4, 16, 16, generator=torch.Generator().manual_seed(5))
    pipeline.scheduler.set_timesteps(1)
    t = pipeline.scheduler.timesteps
    result = pipeline(
        "a horse with wings",
        ip_adapter_image=Image.open(root / "picture.png").convert("RGB"),
        num_inference_steps=1,
        guidance_scale=7.5,
        negative_prompt="blurry",
        latents=z_t,
        output_type="latent",
    ).images
    texts = {"text": guidance.texts.embed(["a horse with wings"]), "plain": guidance.texts.embed(["blurry"])}
    guidance.looks_at_picture = True
    with torch.no_grad():
        seen = guidance.predict_noise(z_t, t, texts)
    noise = seen["plain"] + 7.5 * (seen["text"] - seen["plain"])
    torch.testing.assert_close(result, pipeline.scheduler.step(noise, t[0], z_t).prev_sample, rtol=1e-4, atol=1e-4)


def test_the_geometry_stage_does_not_look_at_the_picture(root: Path, guidance: DiffusionGuidance) -> None:
    plain = DiffusionGuidance.load(
        GuidanceConfig(model=str(root / "sd15"), view_prompts=False), appearance=guidance.appearance
    )
    plain.set_prompt("a horse with wings", "blurry")
    pictures = torch.rand(1, 5, 16, 16, generator=torch.Generator().manual_seed(0)).requires_grad_()
    shapes = GuidanceViews(pictures, None, [0.0], [0.0])
    colours = torch.rand(1, 3, 128, 128, generator=torch.Generator().manual_seed(1)).requires_grad_()
    whole = torch.ones(1, 1, 128, 128)
    lit = AppearanceViews(colours, None, whole, whole, whole, [0.0], [0.0])
    for _ in range(2):  # whichever came before
        shape, material = (
            torch.autograd.grad(of.guide(shapes, 0, 10, "coarse", 3).loss, pictures)[0] for of in (plain, guidance)
        )
        torch.testing.assert_close(shape, material, rtol=1e-5, atol=1e-7)
        one, other = (
            torch.autograd.grad(of.guide_appearance(lit, 0, 10, 3).loss, colours)[0] for of in (plain, guidance)
        )
        assert (one - other).abs().max() > 1e-2 * one.abs().max()


def changed(root: Path, folder: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> dict[str, object]:
    tensors = load_file(root / "adapter" / "ip-adapter.safetensors")
    change(tensors)
    save_file(tensors, folder / "a.safetensors")
    return {"ip_adapter": str(folder / "a.safetensors")}


BAD: dict[str, tuple[Callable[[Path, Path], dict[str, object]], str]] = {
    "no adapter": (lambda root, folder: {"ip_adapter": ""}, "guidance.ip_adapter: is missing"),
    "no picture": (lambda root, folder: {"image_prompt": "/no/such.png"}, "is no picture that can be read"),
    "not a picture": (lambda root, folder: {"image_prompt": str(root / "encoder" / "config.json")}, "is no picture"),
    "no encoder": (lambda root, folder: {"ip_adapter_encoder": str(folder)}, "has no config.json"),
    "text encoder": (
        lambda root, folder: {"ip_adapter_encoder": str(root / "sd15" / "text_encoder")},
        "is no CLIPVisionModelWithProjection",
    ),
    "missing file": (lambda root, folder: {"ip_adapter": "/no/such"}, "correct guidance.ip_adapter"),
    "plus": (
        lambda root, folder: changed(root, folder, lambda t: t.update({"image_proj.latents": torch.ones(1)})),
        "is no plain IP-Adapter",
    ),
    "other model": (
        lambda root, folder: changed(root, folder, lambda t: t.update({"image_proj.norm.weight": torch.ones(64)})),
        "its words have 64 numbers, the model's 48",
    ),
    "other encoder": (
        lambda root, folder: changed(
            root, folder, lambda t: t.update({"image_proj.proj.weight": torch.ones(TOKENS * WIDTH, 32)})
        ),
        "reads 32 numbers of a picture, the image encoder gives 24",
    ),
    "other layers": (
        lambda root, folder: changed(root, folder, lambda t: t.pop("ip_adapter.3.to_k_ip.weight")),
        "cannot be put into the model",
    ),
    "no matrix": (
        lambda root, folder: changed(root, folder, lambda t: t.update({"image_proj.proj.weight": torch.ones(SAID)})),
        "image_proj.norm.weight (48,) and proj.weight (24,) are no vector and no matrix",
    ),
    "no vector": (
        lambda root, folder: changed(root, folder, lambda t: t.update({"image_proj.norm.weight": torch.tensor(1.0)})),
        "image_proj.norm.weight () and",
    ),
    "nan": (
        lambda root, folder: changed(root, folder, lambda t: t["ip_adapter.1.to_k_ip.weight"].fill_(torch.nan)),
        "ip_adapter.1.to_k_ip.weight has values that are not finite",
    ),
    "builtin": (lambda root, folder: {"model": "builtin"}, "made for Stable Diffusion"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_does_not_fit_is_one_line(root: Path, tmp_path: Path, case: str) -> None:
    make, expected = BAD[case]
    with pytest.raises(UserError) as caught:
        load(root, **make(root, tmp_path))
    assert expected in str(caught.value) and "\n" not in str(caught.value)
