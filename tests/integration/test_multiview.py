"""Models that see several views at once, on random weights, against a UNet that is written in the tests themselves."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import diffusers
import numpy as np
import pytest
import torch
from accelerate import init_empty_weights
from diffusers.models.attention_processor import Attention
from safetensors.torch import save_file
from test_whole_run import SETTINGS
from tiny_guidance import components_of, load
from tiny_multiview import CONFIG, MultiViewUNet, edit, made_unet, save_multiview
from tiny_pipelines import save_pipeline
from tiny_runs import write_place
from torch import Tensor

from fd_mitsuba.backend.processes import Processes
from fd_mitsuba.baselines.edit_maps import refuse_without_attention
from fd_mitsuba.baselines.voxe import VoxeSettings
from fd_mitsuba.cli.main import main
from fd_mitsuba.config import GuidanceConfig, RunConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import loading, picture_gradient, step_draws
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews
from fd_mitsuba.guidance.multiview import JointAttention, camera_conditions
from fd_mitsuba.guidance.multiview_layout import unet_config
from fd_mitsuba.training.record import read_metrics

AZIMUTHS, ELEVATIONS = [10.0, 100.0, 190.0, 280.0], [20.0] * 4


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("multiview")
    save_multiview(folder / "mvdream")
    shutil.copytree(folder / "mvdream", folder / "converted")
    components_of(folder / "mvdream").unet.save_pretrained(folder / "converted" / "unet")
    edit(folder / "converted" / "model_index.json", unet=["diffusers", "UNet2DConditionModel"])
    return folder


@pytest.fixture(scope="module")
def reference() -> MultiViewUNet:
    return made_unet()


def inputs(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    z_t, texts = (torch.randn(count, *shape, generator=generator) for shape in ((4, 8, 8), (7, 64)))
    cameras = camera_conditions(AZIMUTHS * (count // 4), ELEVATIONS * (count // 4))
    return z_t, torch.arange(count) // 4 * 300 + 100, texts, cameras


def views_of(count: int = 8) -> GuidanceViews:
    generator = torch.Generator().manual_seed(1)
    pictures = torch.rand(count, 5, 8, 8, generator=generator)
    angles = AZIMUTHS + [azimuth + 45 for azimuth in AZIMUTHS]
    return GuidanceViews(pictures.requires_grad_(), None, angles[:count], ([20.0] * 4 + [5.0] * 4)[:count])


def gradient_of(guidance: DiffusionGuidance, views: GuidanceViews) -> Tensor:
    return torch.autograd.grad(guidance.guide(views, 2, 10, "coarse", seed=3).loss, views.pictures)[0]


def assert_close(got: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Relative to the largest."""
    assert (got - expected).abs().max() < tolerance * expected.abs().max()


# Joint attention.


def test_joint_attention_is_plain_attention_of_one_long_sequence() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        attention = Attention(12, heads=3, dim_head=4).requires_grad_(False)
        rows = torch.randn(6, 5, 12)
    attention.set_processor(JointAttention(3))
    weights = dict(attention.named_parameters())
    expected = []
    for group in rows.split(3):
        tokens = group.reshape(15, 12)
        q, k, v = (tokens @ weights[f"to_{name}.weight"].T for name in "qkv")
        heads = [
            torch.softmax(q[:, h : h + 4] @ k[:, h : h + 4].T / 2, dim=1) @ v[:, h : h + 4] for h in range(0, 12, 4)
        ]
        out = torch.cat(heads, dim=1) @ weights["to_out.0.weight"].T + weights["to_out.0.bias"]
        expected.append(out.reshape(3, 5, 12))
    torch.testing.assert_close(attention(rows), torch.cat(expected), rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="4 views do not fill groups of 3"):
        attention(rows[:4])


@pytest.mark.parametrize("name", ["mvdream", "converted"])
def test_the_loaded_network_is_the_reference(root: Path, reference: MultiViewUNet, name: str) -> None:
    """Two groups at two timesteps: weights under other names, camera embedding, timesteps, joint attention."""
    guidance = load(root / name)
    z_t, times, texts, cameras = inputs(8)
    with torch.no_grad():
        got = guidance.predict_noise(z_t, times, {"text": texts}, Beside(cameras=cameras))["text"]
        assert_close(got, reference(z_t, times, texts, cameras, 4), 1e-5)
        alone = reference(z_t, times, texts, cameras, 1)
    assert (got - alone).abs().max() > 1e-3 * alone.abs().max(), "the views see each other"


def test_groups_never_mix(root: Path) -> None:
    """Nor do passes: a group is the same whatever else is in the call, however many rows a call may have."""
    z_t, times, texts, cameras = inputs(8)
    with torch.no_grad():
        seen = {
            most: load(root / "mvdream", views_per_call=most).predict_noise(
                z_t, times, {"text": texts, "plain": texts.flip(0)}, Beside(cameras=cameras)
            )
            for most in (4, 7, 8, 64)
        }
        few = z_t[:4], times[:4], {"text": texts[:4]}, Beside(cameras=cameras[:4])
        first = load(root / "mvdream").predict_noise(*few)
    for most in (7, 8, 64):
        for name, noise in seen[4].items():
            assert_close(seen[most][name], noise, 1e-5)
    assert_close(seen[4]["text"][:4], first["text"], 1e-5)


def test_one_view_a_group_and_no_cameras_is_the_plain_unet(root: Path, tmp_path: Path) -> None:
    """With an MLP of zeros, Stable Diffusion's own UNet with the same weights."""
    folder = shutil.copytree(root / "converted", tmp_path / "model")
    (folder / "fd_mitsuba.json").write_text('{"views_together": 1}')
    unet = diffusers.UNet2DConditionModel.from_pretrained(folder / "unet")
    plain = diffusers.UNet2DConditionModel.from_config(
        {**unet.config, "class_embed_type": None, "projection_class_embeddings_input_dim": None}
    )
    plain.load_state_dict({name: value for name, value in unet.state_dict().items() if "class_emb" not in name})
    for parameter in unet.class_embedding.parameters():
        torch.nn.init.zeros_(parameter)
    unet.save_pretrained(folder / "unet")
    z_t, times, texts, cameras = inputs(4)
    with torch.no_grad():
        got = load(folder).predict_noise(z_t, times, {"text": texts}, Beside(cameras=cameras))["text"]
        assert_close(got, plain(z_t, times, texts).sample, 1e-5)


def test_the_published_config_has_the_weights_of_its_base_and_an_mlp() -> None:
    """Stable Diffusion 2.1's UNet has 865,910,724; the MLP leads from 16 numbers over 1280 to 1280."""
    published = CONFIG | dict(image_size=32, model_channels=320, num_res_blocks=2, channel_mult=[1, 2, 4, 4])
    published |= dict(attention_resolutions=[4, 2, 1], num_head_channels=64, context_dim=1024)
    config = unet_config(Path("config.json"), {"_class_name": "MultiViewUNetModel"} | published)
    with init_empty_weights():
        unet = diffusers.UNet2DConditionModel.from_config(config)
    assert sum(weight.numel() for weight in unet.parameters()) == 865_910_724 + 17 * 1280 + 1281 * 1280
    heads = {block.to_q.in_features: block.heads for name, block in unet.named_modules() if name.endswith("attn1")}
    assert heads == {320: 5, 640: 10, 1280: 20}, "of 64 channels each"


# Guidance.


@pytest.mark.parametrize("settings", [{}, {"views_per_call": 16}], ids=["by group", "at once"])
def test_the_gradient_by_hand(root: Path, reference: MultiViewUNet, settings: dict[str, int]) -> None:
    guidance, views = load(root / "mvdream", guidance_scale=7.5, **settings), views_of()
    times, noise = guidance.draws.of_step(8, 2, 10, "coarse", 3)
    assert times[0] == times[3] != times[4] == times[7], "one timestep a group"
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(root / "converted", safety_checker=None)
    text, plain = pipeline.encode_prompt(["a horse with wings, 3d asset"] * 8, "cpu", 1, True, ["blurry"] * 8)
    cameras = camera_conditions(views.azimuth_deg, views.elevation_deg)
    alpha_bar = pipeline.scheduler.alphas_cumprod[times].view(-1, 1, 1, 1)
    z_t = pipeline.scheduler.add_noise(views.pictures.detach()[:, :4], noise, times)
    with torch.no_grad():
        e = [reference(z_t, times, states, cameras, 4) for states in (text, plain)]
    expected = (1 - alpha_bar) * (e[1] + 7.5 * (e[0] - e[1]) - noise) / 8
    got = gradient_of(guidance, views)
    assert_close(got[:, :4], expected)
    assert (got[:, 4] == 0).all()


def test_the_gradient_of_the_appearance_stage_by_hand(root: Path, reference: MultiViewUNet) -> None:
    guidance = load(root / "mvdream", AppearanceConfig(mask_guidance=False, guidance_scale=7.5))
    assert guidance.appearance_size == 64
    colours = torch.rand(4, 3, 64, 64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    whole = torch.ones(4, 1, 64, 64)
    views = AppearanceViews(colours, None, whole, whole, whole, AZIMUTHS, ELEVATIONS)
    times, noise = guidance.draws.of_step(4, 0, 10, "appearance", 3)
    z = guidance.components.vae.encode(2 * colours - 1).latent_dist.mean * guidance.components.vae.config.scaling_factor
    alpha_bar = guidance.components.scheduler.alphas_cumprod[times].view(-1, 1, 1, 1)
    z_t = alpha_bar.sqrt() * z.detach() + (1 - alpha_bar).sqrt() * noise
    cameras = camera_conditions(AZIMUTHS, ELEVATIONS)
    with torch.no_grad():
        texts = [guidance.texts.embed([text] * 4) for text in ("a horse with wings, 3d asset", "blurry")]
        e = [reference(z_t, times, states, cameras, 4) for states in texts]
    w = 1 / (1 - alpha_bar)
    expected = torch.autograd.grad(z, colours, w * (e[1] + 7.5 * (e[0] - e[1]) - noise) / 4)[0]
    got = torch.autograd.grad(guidance.guide_appearance(views, 0, 10, 3).loss, colours)[0]
    assert_close(got, expected)


@pytest.mark.parametrize(
    "variant",
    ["csd", {"kind": "ism", "inversion_step": 0.4}, {"kind": "reconstruction", "steps": 2}],
    ids=["csd", "ism", "reconstruction"],
)
def test_a_view_pulls_at_the_others_of_its_group_alone(root: Path, variant: str | dict) -> None:
    guidance, views = load(root / "mvdream", variant=variant, guidance_scale=7.5), views_of()
    other = views.pictures.detach().clone()
    other[1, :4] *= -1
    changed = gradient_of(guidance, views) - gradient_of(guidance, replace(views, pictures=other.requires_grad_()))
    apart = changed[:, :4].abs().amax(dim=(1, 2, 3))
    assert (apart[:4] > 1e-6).all() and (apart[4:] == 0).all()


def test_a_critic_is_told_the_cameras_too(root: Path) -> None:
    """One that has learned nothing sees what the model sees, which leaves (7.5 - 1) times the classifier score."""
    guidance, views = load(root / "mvdream", variant="vsd", guidance_scale=7.5), views_of()
    plain = load(root / "mvdream", variant="csd")
    first, expected = (
        torch.autograd.grad(asked.guide(views, 0, 10, "coarse", 3).loss, views.pictures)[0]
        for asked in (guidance, plain)
    )
    assert_close(first, 6.5 * expected)
    moved = [value for name, value in guidance.learned_state().items() if name.endswith(".up")]
    assert all(value.abs().max() > 0 for value in moved), "every layer has learned"
    times, _ = guidance.draws.lesson(views, 1, "coarse", 3)
    assert times[0] == times[3] != times[4] == times[7]


def test_a_baseline_that_looks_at_single_views_refuses_it(root: Path) -> None:
    task = SimpleNamespace(
        guidance=SimpleNamespace(inner=load(root / "mvdream")),
        config=RunConfig.load(None, ["guidance.model=mvdream"]),
    )
    with pytest.raises(UserError, match="guidance.model = mvdream: voxe needs a diffusion model that sees one whole"):
        refuse_without_attention(task, VoxeSettings())


def test_a_part_with_a_prompt_of_its_own_is_told_the_same_cameras(root: Path) -> None:
    """Where its regions are everywhere, the scene's prompt plays no part; so it is with Perp-Neg."""
    one, other = (load(root / "mvdream", guidance_scale=7.5, perp_neg=0.7) for _ in range(2))
    views = replace(views_of(), regions={"hat": torch.ones(8, 1, 8, 8)})
    one.set_part_prompts({"hat": ("a crown", "horse")})
    other.set_prompt("a crown", "horse")
    assert_close(gradient_of(one, views), gradient_of(other, views), 1e-5)


def test_a_lora_for_stable_diffusion_goes_on_top(root: Path, reference: MultiViewUNet, tmp_path: Path) -> None:
    place = "down_blocks.0.attentions.0.transformer_blocks.0.attn1.to_q"
    down, up = torch.rand(2, 2, 32, generator=torch.Generator().manual_seed(0))
    up = up.T.contiguous()
    save_file({f"unet.{place}.lora_A.weight": down, f"unet.{place}.lora_B.weight": up}, tmp_path / "own.safetensors")
    config = GuidanceConfig(model=str(root / "mvdream"), lora=(str(tmp_path / "own.safetensors"),), lora_scale=0.5)
    changed = loading.load_components(config).unet.get_submodule(place).weight
    before = reference.input_blocks[1][1].transformer_blocks[0].attn1.to_q.weight
    torch.testing.assert_close(changed, before + 0.5 * up @ down)


def test_the_shares_of_two_processes_add_up_to_the_whole(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guidance, views, shares = load(root / "mvdream"), views_of(), []
    whole = gradient_of(guidance, views)
    for rank in range(2):
        for module in (picture_gradient, step_draws):
            monkeypatch.setattr(module, "processes", lambda rank=rank: Processes(rank, 2))
        own = Processes(rank, 2).share(8)
        pictures = views.pictures[own].detach().requires_grad_()
        angles = views.azimuth_deg[own], views.elevation_deg[own]
        shares.append(gradient_of(guidance, GuidanceViews(pictures, None, *angles, share=own)))
    assert_close(torch.cat(shares), whole)


def test_groups_must_be_whole(root: Path) -> None:
    guidance = load(root / "mvdream")
    assert guidance.views_together == 4 and guidance.picture_size("refined") == 64
    with pytest.raises(ValueError, match="6 views do not fill groups of 4"):
        gradient_of(guidance, views_of(6))
    with pytest.raises(UserError, match="multi-view model, which must be told its cameras"):
        guidance.predict_noise(*inputs(4)[:2], {"text": inputs(4)[2]})


# What cannot be.

UNET = "unet/config.json"
BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "a picture": (lambda f: edit(f / UNET, ip_dim=16), "ip_dim = 16: is made to be shown a picture"),
    "no cameras": (lambda f: edit(f / UNET, camera_dim=None), "camera_dim is None"),
    "other cameras": (lambda f: edit(f / UNET, camera_dim=12), "camera_dim is 12; take a model"),
    "no widths": (lambda f: edit(f / UNET, channel_mult=None), "has no channel_mult"),
    "no heads": (lambda f: edit(f / UNET, num_head_channels=-1), "entries are not those of a MultiViewUNetModel"),
    "blocks of a list": (lambda f: edit(f / UNET, num_res_blocks=[1, 2]), "entries are not those"),
    "deeper": (lambda f: edit(f / UNET, transformer_depth=2), "transformer_depth = 2 has no place"),
    "inpainting": (lambda f: edit(f / UNET, in_channels=9), "is told cameras and has 9 input channels"),
    "more layers": (lambda f: edit(f / UNET, num_res_blocks=2), "the config asks for"),
    "other widths": (lambda f: edit(f / UNET, model_channels=64), "unet: cannot be loaded"),
    "no side": (lambda f: edit(f / UNET, image_size="x"), "image_size is 'x', not a whole number above 0"),
    "no channels": (lambda f: edit(f / UNET, model_channels=0), "entries are not those"),
    "mosaics": (lambda f: (f / "fd_mitsuba.json").write_text('{"view_grid": 2}'), "see no mosaics"),
    "pickled": (
        lambda f: (f / "unet/diffusion_pytorch_model.safetensors").rename(f / "unet/model.bin"),
        "pickled weights only",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_folder_that_does_not_fit_is_one_line(root: Path, tmp_path: Path, case: str) -> None:
    spoil, expected = BAD[case]
    folder = shutil.copytree(root / "mvdream", tmp_path / "model")
    spoil(folder)
    with pytest.raises(UserError) as caught:
        loading.load_components(GuidanceConfig(model=str(folder)))
    assert expected in str(caught.value) and str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"controlnet": "control"}, "guidance.controlnet: .* is a multi-view model"),
        ({"image_prompt": "a.png", "ip_adapter": "b", "ip_adapter_encoder": "c"}, "guidance.image_prompt: .* multi"),
        ({"views_per_call": 3}, "guidance.views_per_call = 3: .* sees 4 views at once; set it to 4 or more"),
    ],
)
def test_settings_that_do_not_go_with_it_are_one_line(root: Path, settings: dict[str, object], expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        loading.load_components(GuidanceConfig(model=str(root / "mvdream"), **settings))


def test_a_plain_model_has_no_groups(tmp_path: Path) -> None:
    folder = save_pipeline("sd15", tmp_path / "sd15", {"views_together": 4})
    with pytest.raises(UserError, match="views_together is 4, and the UNet is told no cameras"):
        loading.load_components(GuidanceConfig(model=str(folder)))


@pytest.mark.slow
def test_a_run_of_both_stages(root: Path, tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]) -> None:
    """Three steps of each, as published; two views fewer than a group end in one line."""
    settings = SETTINGS.replace("steps = 2", "steps = 3").replace("views = 2", "views = 4")
    place = write_place(tmp_path, animal, settings)
    words = ["run", place / "scene.xml", "-c", place / "tiny.toml", "--set", f"guidance.model={root / 'mvdream'}"]
    line = [str(word) for word in (*words, "-o", place / "run", "-q", "-t", "1")]
    assert main([*line, "--set", "appearance.views=2"]) == 1
    shutil.rmtree(place / "run", ignore_errors=True)
    assert main(line) == 0
    rows = read_metrics(place / "run" / "metrics.jsonl")
    assert [row["phase"] for row in rows] == ["coarse", "coarse", "refined", *["appearance"] * 3]
    assert all(row["loss_sds"] > 0 for row in rows)
