"""The Diffusers adapter on pipelines of Stable Diffusion's true layout, saved by diffusers, loaded from the folder."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import diffusers
import pytest
import safetensors.torch
import torch
from tiny_guidance import components_of, load
from tiny_pipelines import save_pipeline

from fd_mitsuba.config import GuidanceConfig, RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import builtin, loading, memory
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews, NonFiniteGuidance
from fd_mitsuba.runs.model_check import check_model

KINDS = ("sd15", "sd21", "ip2p", "tiny_vae")
OF_TWO_STEPS = {"kind": "reconstruction", "steps": 2}
SHORT_ISM = {"kind": "ism", "inversion_step": 0.4}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("pipelines")
    made = {kind: save_pipeline(kind, root / kind) for kind in KINDS}
    made["mosaic"] = shutil.copytree(made["ip2p"], root / "mosaic")
    (made["mosaic"] / "fd_mitsuba.json").write_text('{"view_grid": 2, "normal_space": "camera", "needs_base": true}')
    return made


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


def views_for(guidance: DiffusionGuidance, phase: str, count: int = 4, seed: int = 0) -> GuidanceViews:
    """Pictures that could be renders: unit normals times coverage, mask, part mask."""
    size = guidance.picture_size(phase)
    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(2, count, 3, size, size, generator=generator), dim=2)
    mask = (torch.rand(2, count, 1, size, size, generator=generator) > 0.4).float()
    pictures, base = torch.cat([normals * mask, mask, mask], dim=2)
    azimuths = [90.0 * index for index in range(count)]
    return GuidanceViews(pictures.requires_grad_(), base, azimuths, [20.0] * count)


def gradient_of(guidance: DiffusionGuidance, views: GuidanceViews, phase: str, **call: int) -> torch.Tensor:
    result = guidance.guide(views, phase=phase, **({"step": 0, "steps_total": 10, "seed": 3} | call))
    return torch.autograd.grad(result.loss, views.pictures)[0]


@pytest.mark.parametrize("kind", [*KINDS, "mosaic"])
def test_three_steps_of_both_phases(folders: dict[str, Path], kind: str) -> None:
    guidance = load(folders[kind])
    assert guidance.picture_size("coarse") == (8 if kind == "mosaic" else 16)
    assert guidance.picture_size("refined") == (64 if kind == "mosaic" else 128)
    assert guidance.needs_base == (kind in ("ip2p", "mosaic"))
    count = 4 if kind == "mosaic" else 2
    for phase in ("coarse", "refined"):
        views = views_for(guidance, phase, count)
        for step in range(3):
            result = guidance.guide(views, step, 3, phase, seed=7)
            (gradient,) = torch.autograd.grad(result.loss, views.pictures)
            assert math.isfinite(result.loss.item()) and gradient.isfinite().all()
            assert (gradient[:, :4].abs().amax(dim=(1, 2, 3)) > 0).all()
            assert (gradient[:, 4] == 0).all(), "the part mask is no input of the model"
            assert 20 <= result.logs["guidance_timestep"] <= 350
            assert result.preview.shape == (1 if kind == "mosaic" else count, 4, 16, 16)


@pytest.mark.parametrize(
    ("kind", "phase", "variant"),
    [
        ("sd21", "refined", "sds"),
        ("ip2p", "refined", "csd"),
        ("ip2p", "coarse", OF_TWO_STEPS),
        ("sd15", "coarse", SHORT_ISM),
    ],
)
def test_chunks_give_what_one_call_gives(folders: dict[str, Path], kind: str, phase: str, variant: str | dict) -> None:
    settings = {"variant": variant, "image_guidance_scale": 1.5, "guidance_scale": 7.5, "normalise_gradient": True}
    gradients = []
    for views_per_call in (1, 4, 64):
        guidance = load(folders[kind], views_per_call=views_per_call, **settings)
        gradients.append(gradient_of(guidance, views_for(guidance, phase, 2), phase))
    largest = gradients[-1].abs().max()
    for gradient in gradients[:2]:
        assert (gradient - gradients[-1]).abs().max() < 1e-4 * largest


def test_seed_and_step_decide_everything(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    views = views_for(guidance, "coarse", 2)
    first = gradient_of(guidance, views, "coarse")
    torch.manual_seed(99)
    assert gradient_of(guidance, views, "coarse").equal(first)
    assert not gradient_of(guidance, views, "coarse", seed=4).equal(first)
    assert not gradient_of(guidance, views, "coarse", step=1).equal(first)


def test_global_random_state_is_left_alone(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    state = torch.get_rng_state()
    gradient_of(guidance, views_for(guidance, "refined", 1), "refined")
    assert torch.get_rng_state().equal(state)


def test_views_have_their_own_prompts_and_the_prompt_matters(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    views = views_for(guidance, "coarse")
    assert guidance.prompts(views) == [f"a horse with wings, {word} view" for word in ("front", "side", "back", "side")]
    before = gradient_of(guidance, views, "coarse")
    guidance.set_prompt("a crown", "blurry")
    assert not gradient_of(guidance, views, "coarse").equal(before)
    guidance.set_prompt("a horse with wings", "")
    assert not gradient_of(guidance, views, "coarse").equal(before)


def test_a_mosaic_is_one_picture_to_the_network(folders: dict[str, Path]) -> None:
    """Four views through the mosaic model equal one tiled picture through the same weights without the mosaic."""
    mosaic, single = load(folders["mosaic"], view_prompts=False), load(folders["ip2p"], view_prompts=False)
    views = views_for(mosaic, "coarse")
    whole, base = (
        torch.cat([torch.cat(list(p[:2]), dim=2), torch.cat(list(p[2:]), dim=2)], dim=1)[None]
        for p in (views.pictures.detach(), views.base)
    )
    one = GuidanceViews(whole.requires_grad_(), base, [0.0], [20.0])
    expected = gradient_of(single, one, "coarse")[0]
    got = gradient_of(mosaic, views, "coarse")
    torch.testing.assert_close(got[1], expected[:, :8, 8:])
    torch.testing.assert_close(got[2], expected[:, 8:, :8])


# What the adapter predicts, against diffusers' own pipeline code.


@pytest.mark.parametrize("kind", ["sd15", "sd21"])
def test_noise_equals_the_pipelines_own(folders: dict[str, Path], kind: str) -> None:
    guidance = load(folders[kind], guidance_scale=7.5, timestep_range_coarse=(0.4, 0.4))
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(folders[kind], safety_checker=None)
    generator = torch.Generator().manual_seed(0)
    z_t, t = torch.randn(2, 4, 16, 16, generator=generator), torch.tensor([400, 17])
    text, negative = pipeline.encode_prompt(["a horse", "wings"], "cpu", 1, True, ["blurry", "blurry"])
    with torch.no_grad():
        outputs = pipeline.unet(z_t.repeat(2, 1, 1, 1), t.repeat(2), torch.cat([negative, text])).sample
        plain, conditioned = outputs.chunk(2)
        output = plain + 7.5 * (conditioned - plain)
        embeddings = {
            "text": guidance.texts.embed(["a horse", "wings"]),
            "plain": guidance.texts.embed(["blurry", "blurry"]),
        }
        passes = guidance.predict_noise(z_t, t, embeddings)
    got = 7.5 * passes["text"] - 6.5 * passes["plain"]
    if kind == "sd21":  # the scheduler's own step tells the noise that it took v for
        for row in range(2):
            abar = pipeline.scheduler.alphas_cumprod[t[row]]
            expected = abar.sqrt() * output[row] + (1 - abar).sqrt() * z_t[row]
            pipeline.scheduler.set_timesteps(1000)
            z_0 = pipeline.scheduler.step(output[row], int(t[row]), z_t[row]).pred_original_sample
            torch.testing.assert_close(z_t[row], abar.sqrt() * z_0 + (1 - abar).sqrt() * expected, rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(got[row], expected, rtol=1e-3, atol=1e-4)
    else:
        torch.testing.assert_close(got, output, rtol=1e-3, atol=1e-4)


def test_instruct_pix2pix_step_equals_the_pipelines_own(folders: dict[str, Path]) -> None:
    """One denoising step of the whole pipeline, its condition and its three passes included."""
    guidance = load(folders["ip2p"], guidance_scale=7.5, image_guidance_scale=1.5)
    pipeline = diffusers.StableDiffusionInstructPix2PixPipeline.from_pretrained(folders["ip2p"], safety_checker=None)
    pipeline.scheduler = diffusers.DDIMScheduler.from_config(pipeline.scheduler.config, clip_sample=False)
    pipeline.set_progress_bar_config(disable=True)
    views = views_for(guidance, "refined", 1)
    colour = views.base[:, :3] + views.base[:, 3:4] - 1
    z_t = torch.randn(1, 4, 16, 16, generator=torch.Generator().manual_seed(5))
    pipeline.scheduler.set_timesteps(1)
    t = pipeline.scheduler.timesteps
    result = pipeline(
        "a horse",
        image=(colour + 1) / 2,
        num_inference_steps=1,
        guidance_scale=7.5,
        image_guidance_scale=1.5,
        negative_prompt="blurry",
        latents=z_t,
        output_type="latent",
    ).images
    texts = {"text": guidance.texts.embed(["a horse"])} | {
        n: guidance.texts.embed(["blurry"]) for n in ("image", "plain")
    }
    condition = guidance.seen_base(views.base, "refined")
    with torch.no_grad():
        passes = guidance.predict_noise(z_t, t, texts, Beside(condition))
    noise = passes["plain"] + 1.5 * (passes["image"] - passes["plain"]) + 7.5 * (passes["text"] - passes["image"])
    expected = pipeline.scheduler.step(noise, t[0], z_t).prev_sample
    torch.testing.assert_close(result, expected, rtol=1e-3, atol=1e-3)
    with torch.no_grad():  # not scaled, as the pipeline's own
        torch.testing.assert_close(condition, pipeline.vae.encode(colour).latent_dist.mode())


def test_a_network_that_says_the_difference_is_added_to_what_it_saw(folders: dict[str, Path], tmp_path: Path) -> None:
    """The clean latents that its noise implies are its output plus the condition, or plus nothing in the plain pass."""
    folder = shutil.copytree(folders["ip2p"], tmp_path / "difference")
    edit_json(folder / "scheduler/scheduler_config.json", prediction_type="sample")
    (folder / "fd_mitsuba.json").write_text('{"predicts": "difference"}')
    guidance = load(folder)
    generator = torch.Generator().manual_seed(2)
    z_t, condition = (torch.randn(2, 4, 16, 16, generator=generator) for _ in range(2))
    t, texts = torch.tensor([300, 800]), {name: guidance.texts.embed(["a horse"] * 2) for name in ("text", "plain")}
    alpha_bar = guidance.alpha_bars[t].view(-1, 1, 1, 1)
    with torch.no_grad():
        noise = guidance.predict_noise(z_t, t, texts, Beside(condition))
        for name, seen in (("text", condition), ("plain", torch.zeros_like(condition))):
            said = guidance.components.unet(torch.cat([z_t, seen], 1), t, texts[name]).sample
            clean = (z_t - (1 - alpha_bar).sqrt() * noise[name]) / alpha_bar.sqrt()
            torch.testing.assert_close(clean, said + seen, rtol=1e-3, atol=1e-3)


def test_refined_latents_are_scaled_as_for_image_to_image(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    views = views_for(guidance, "refined", 1)
    pictures = views.pictures.detach()
    covered = pictures[:, 3:4] > 0
    colour = torch.where(covered, (pictures[:, :3] + 1) / 2, torch.zeros(())) * 2 - 1
    with torch.no_grad():
        expected = guidance.components.vae.encode(colour).latent_dist.mean * 0.18215
        torch.testing.assert_close(guidance.encode(pictures, "refined"), expected)


def test_coarse_latents_are_normals_and_mask(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    pictures = views_for(guidance, "coarse", 1).pictures.detach()
    latents = guidance.encode(pictures, "coarse")
    assert latents[:, :3].equal(pictures[:, :3])
    assert set(latents[:, 3].unique().tolist()) == {0.0, 1.0}, "the paper: directly concatenated"
    signed = load(folders["sd15"], mask_channel="signed").encode(pictures, "coarse")
    assert signed[:, :3].equal(latents[:, :3]) and signed[:, 3:].equal(2 * latents[:, 3:] - 1)


# Gradients in closed form, with the network replaced by one whose answer is known.


class _PointMass(torch.nn.Module):
    """The perfect denoiser of a data set with one member: e_hat = (z_t - sqrt(abar) m) / sqrt(1 - abar)."""

    dtype = torch.float32

    def __init__(self, member: float, alpha_bars: torch.Tensor, like: torch.nn.Module) -> None:
        super().__init__()
        self.member, self.alpha_bars, self.config = member, alpha_bars, like.config
        self.pictures: list[int] = []

    def forward(self, z_t: torch.Tensor, t: torch.Tensor, **_: object) -> tuple[torch.Tensor]:
        self.pictures.append(len(z_t))
        abar = self.alpha_bars[t].view(-1, 1, 1, 1)
        return ((z_t[:, :4] - abar.sqrt() * self.member) / (1 - abar).sqrt(),)


def with_point_mass(folder: Path, **settings: object) -> DiffusionGuidance:
    guidance = load(folder, timestep_range_coarse=(0.3, 0.3), **settings)
    network = _PointMass(0.25, guidance.alpha_bars, guidance.components.unet)
    guidance.components = replace(guidance.components, unet=network)
    return guidance


@pytest.mark.parametrize("weighting", ["sds", "uniform", "fantasia3d", "inverse"])
@pytest.mark.parametrize("variant", ["sds", "reconstruction"])
def test_gradient_of_a_known_denoiser(folders: dict[str, Path], variant: str, weighting: str) -> None:
    """SDS: w sqrt(abar / (1 - abar)) (z - m); reconstruction: w (z - m); both divided by the number of pictures."""
    guidance = with_point_mass(folders["sd15"], variant=variant, weighting=weighting)
    views = views_for(guidance, "coarse", 2)
    abar = float(diffusers.PNDMScheduler.from_pretrained(folders["sd15"] / "scheduler").alphas_cumprod[300])
    w = {"sds": 1 - abar, "uniform": 1, "fantasia3d": math.sqrt(abar) * (1 - abar), "inverse": 1 / (1 - abar)}[
        weighting
    ]
    if variant == "sds":
        w *= math.sqrt(abar / (1 - abar))
    pictures = views.pictures.detach()
    expected = w * (pictures[:, :4] - 0.25) / 2
    got = gradient_of(guidance, views, "coarse")[:, :4]
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=2e-4 * w)


@pytest.mark.parametrize(("kind", "variant"), [("sd15", "sds"), ("sd21", "csd"), ("ip2p", "sds"), ("ip2p", "csd")])
def test_gradient_from_the_passes_by_hand(folders: dict[str, Path], kind: str, variant: str) -> None:
    guidance = load(folders[kind], variant=variant, guidance_scale=7.5, image_guidance_scale=1.5, view_prompts=False)
    views = views_for(guidance, "coarse", 2)
    timesteps, noise = guidance.draws.of_step(2, 0, 10, "coarse", 3)
    abar = guidance.alpha_bars[timesteps].view(-1, 1, 1, 1)
    with torch.no_grad():
        z = guidance.encode(views.pictures, "coarse")
        condition = guidance.encode(views.base, "coarse") / 0.18215 if kind == "ip2p" else None
        texts = {"text": "a horse with wings", "image": "blurry", "plain": "blurry"}
        embeddings = {name: guidance.texts.embed([text] * 2) for name, text in texts.items()}
        e = guidance.predict_noise(
            abar.sqrt() * z + (1 - abar).sqrt() * noise, timesteps, embeddings, Beside(condition)
        )
    if variant == "csd":
        difference = e["text"] - e["image"]
    elif kind == "ip2p":
        difference = e["plain"] + 1.5 * (e["image"] - e["plain"]) + 7.5 * (e["text"] - e["image"]) - noise
    else:
        difference = e["plain"] + 7.5 * (e["text"] - e["plain"]) - noise
    expected = (1 - abar) * difference / 2
    got = gradient_of(guidance, views, "coarse")[:, :4]
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=1e-5)


def test_csd_of_a_network_that_ignores_the_text_is_zero(folders: dict[str, Path]) -> None:
    guidance = with_point_mass(folders["ip2p"], variant="csd")
    assert gradient_of(guidance, views_for(guidance, "coarse", 2), "coarse").abs().max() == 0


def test_normalised_gradient_does_not_depend_on_the_weighting(folders: dict[str, Path]) -> None:
    gradients = []
    for weighting in ("uniform", "inverse"):
        guidance = with_point_mass(folders["sd15"], weighting=weighting, normalise_gradient=True)
        gradients.append(gradient_of(guidance, views_for(guidance, "coarse", 2), "coarse"))
    torch.testing.assert_close(*gradients)
    assert gradients[0][:, :4].abs().mean().item() == pytest.approx(1 / 2)


@pytest.mark.parametrize(
    ("kind", "scales", "passes"),
    [
        ("sd15", (1.0, 1.0), 1),
        ("sd15", (7.5, 1.0), 2),
        ("ip2p", (7.5, 1.5), 3),
        ("ip2p", (7.5, 1.0), 2),
        ("ip2p", (1.0, 1.0), 1),
    ],
)
def test_only_passes_that_count_are_run(
    folders: dict[str, Path], kind: str, scales: tuple[float, float], passes: int
) -> None:
    guidance = with_point_mass(
        folders[kind], guidance_scale=scales[0], image_guidance_scale=scales[1], views_per_call=2
    )
    gradient_of(guidance, views_for(guidance, "coarse", 4), "coarse")
    pictures = guidance.components.unet.pictures
    assert sum(pictures) == 4 * passes
    assert max(pictures) <= 2


@pytest.mark.parametrize("annealing", ["linear", "sqrt"])
def test_scheduled_timesteps_are_the_same_for_all_views(folders: dict[str, Path], annealing: str) -> None:
    guidance = load(folders["sd15"], timestep_range_coarse=(0.2, 0.9), timestep_annealing=annealing)
    drawn = [guidance.draws.of_step(2, step, 5, "coarse", 0) for step in range(5)]
    due = [899, 724, 549, 375, 200] if annealing == "linear" else [899, 549, 405, 293, 200]
    assert [timesteps.tolist() for timesteps, _ in drawn] == [[t, t] for t in due]
    views = views_for(guidance, "coarse", 2)
    assert guidance.guide(views, 3, 5, "coarse", seed=0).logs["guidance_timestep"] == due[3]
    assert not guidance.draws.of_step(2, 0, 5, "coarse", 4)[1].equal(drawn[0][1])


@pytest.mark.parametrize("variant", ["csd", SHORT_ISM, OF_TWO_STEPS], ids=["csd", "ism", "reconstruction"])
@pytest.mark.parametrize("kind", ["sd15", "sd21", "ip2p"])
def test_every_variant_guides_every_layout(folders: dict[str, Path], kind: str, variant: str | dict) -> None:
    guidance = load(folders[kind], variant=variant, guidance_scale=7.5, image_guidance_scale=1.5)
    for phase in ("coarse", "refined"):
        views = views_for(guidance, phase, 1)
        first = gradient_of(guidance, views, phase, step=1)
        assert first.isfinite().all() and first[:, :4].abs().max() > 0
    assert gradient_of(guidance, views, phase, step=1).equal(first)


def test_a_device_that_is_not_there_is_told_before_loading(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loading, "_load", lambda *_: pytest.fail("loaded all the same"))
    with pytest.raises(UserError, match=r"guidance.device = 'cuda:99': .* set guidance.device to cpu"):
        DiffusionGuidance.load(GuidanceConfig(model=str(folders["sd15"]), device="cuda:99"))


def test_half_precision_network(folders: dict[str, Path]) -> None:
    full, half = load(folders["sd15"], guidance_scale=2.0), load(folders["sd15"], guidance_scale=2.0, dtype="bfloat16")
    first, second = (gradient_of(g, views_for(g, "refined", 1), "refined").flatten() for g in (full, half))
    assert torch.nn.functional.cosine_similarity(first, second, dim=0) > 0.98


def test_no_gradient_is_made_where_none_is_asked_for(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    views = views_for(guidance, "coarse", 1)
    with torch.no_grad():
        assert not guidance.guide(views, 0, 1, "coarse", 0).loss.requires_grad


def test_a_nan_names_the_timestep(folders: dict[str, Path]) -> None:
    guidance = with_point_mass(folders["sd15"])
    guidance.components.unet.member = math.nan
    with pytest.raises(NonFiniteGuidance, match="timestep 300"):
        gradient_of(guidance, views_for(guidance, "coarse", 1), "coarse")


def test_broken_pictures_are_not_blamed_on_the_model(folders: dict[str, Path]) -> None:
    guidance = load(folders["sd15"])
    views = views_for(guidance, "coarse", 1)
    with torch.no_grad():
        views.pictures[0, 0, 0, 0] = math.inf
    with pytest.raises(NonFiniteGuidance, match="pictures rendered"):
        gradient_of(guidance, views, "coarse")


def test_wrong_pictures_are_refused(folders: dict[str, Path]) -> None:
    guidance = load(folders["mosaic"])
    with pytest.raises(ValueError, match="8 x 8, not 64 x 64"):
        gradient_of(guidance, views_for(guidance, "refined"), "coarse")
    with pytest.raises(ValueError, match="multiple of 4"):
        gradient_of(guidance, views_for(guidance, "coarse", 3), "coarse")
    views = views_for(guidance, "coarse")
    with pytest.raises(ValueError, match="base"):
        gradient_of(guidance, replace(views, base=None), "coarse")
    with pytest.raises(ValueError, match=r"\(B, 5, H, H\)"):
        GuidanceViews(views.pictures[:, :4], None, [0.0] * 4, [0.0] * 4)


# Models that cannot be used: one line each.


def edit_json(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def set_entry(folder: Path, name: str, key: str, value: object) -> None:
    edit_json(folder / name, **{key: value})


def drop_tensor(path: Path) -> None:
    tensors = safetensors.torch.load_file(path)
    tensors.pop("conv_in.weight")
    safetensors.torch.save_file(tensors, path, metadata={"format": "pt"})


def only_pickle(folder: Path) -> None:
    weights = folder / "unet/diffusion_pytorch_model.safetensors"
    weights.rename(weights.with_suffix(".bin"))


def spread(folder: Path, places: object) -> None:
    (folder / UNET_FILE).unlink()
    (folder / f"{UNET_FILE}.index.json").write_text(json.dumps({"weight_map": places}))


def without_words(folder: Path) -> None:
    (folder / "tokenizer" / "tokenizer.json").unlink(missing_ok=True)
    (folder / "tokenizer" / "vocab.json").write_text("{}")
    (folder / "tokenizer" / "merges.txt").write_text("")


UNET_FILE = "unet/diffusion_pytorch_model.safetensors"
BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no index": (lambda f: (f / "model_index.json").unlink(), "no model_index.json"),
    "index not json": (lambda f: (f / "model_index.json").write_text("{"), "model_index.json: not readable JSON"),
    "index a list": (lambda f: (f / "model_index.json").write_text("[]"), "JSON object"),
    "transformer": (
        lambda f: edit_json(
            f / "model_index.json", _class_name="StableDiffusion3Pipeline", transformer=["diffusers", "SD3"], unet=None
        ),
        "StableDiffusion3Pipeline is built on a transformer; only Stable Diffusion 1.x/2.x",
    ),
    "sdxl": (
        lambda f: edit_json(f / "model_index.json", text_encoder_2=["transformers", "CLIPTextModelWithProjection"]),
        "two text encoders",
    ),
    "no unet entry": (lambda f: edit_json(f / "model_index.json", unet=[None, None]), "has no unet"),
    "no vae entry": (lambda f: edit_json(f / "model_index.json", vae=None), "has no vae"),
    "wrong class": (lambda f: edit_json(f / "model_index.json", vae=["diffusers", "VQModel"]), "vae is a VQModel"),
    "no unet folder": (lambda f: shutil.rmtree(f / "unet"), "unet/config.json: missing"),
    "no scheduler": (lambda f: shutil.rmtree(f / "scheduler"), "scheduler_config.json: missing"),
    "no weights": (lambda f: (f / UNET_FILE).unlink(), "diffusion_pytorch_model.safetensors: missing"),
    "pickle only": (only_pickle, "pickled weights only"),
    "rubbish weights": (lambda f: (f / UNET_FILE).write_bytes(b"rubbish" * 99), "damaged weights"),
    "weights cut short": (
        lambda f: (f / UNET_FILE).write_bytes((f / UNET_FILE).read_bytes()[:100_000]),
        "damaged weights",
    ),
    "weights of another model": (
        lambda f: edit_json(f / "unet/config.json", block_out_channels=[32, 64, 96, 128]),
        "expected shape torch.Size([96]), but got torch.Size([128])); copy or fetch",
    ),
    "tensor missing": (lambda f: drop_tensor(f / UNET_FILE), "lack 1 tensors, conv_in.weight"),
    "depth": (lambda f: edit_json(f / "unet/config.json", in_channels=5), "in_channels is 5"),
    "other channels": (lambda f: edit_json(f / "unet/config.json", in_channels=9), "unet: cannot be loaded"),
    "consistency": (lambda f: edit_json(f / "unet/config.json", time_cond_proj_dim=256), "latent consistency model"),
    "controlnet": (
        lambda f: edit_json(f / "model_index.json", controlnet=["diffusers", "ControlNetModel"]),
        "has a controlnet besides",
    ),
    "latent channels": (lambda f: edit_json(f / "vae/config.json", latent_channels=16), "4 latent channels"),
    "text width": (lambda f: edit_json(f / "text_encoder/config.json", hidden_size=64), "cross_attention_dim 48"),
    "not square": (lambda f: edit_json(f / "unet/config.json", sample_size=[16, 24]), "not square"),
    "extra condition": (lambda f: edit_json(f / "unet/config.json", addition_embed_type="text_time"), "condition"),
    "flow matching": (
        lambda f: edit_json(f / "model_index.json", scheduler=["diffusers", "FlowMatchEulerDiscreteScheduler"]),
        "alphas_cumprod",
    ),
    "unknown scheduler": (lambda f: edit_json(f / "model_index.json", scheduler=["diffusers", "Nope"]), "Nope"),
    "prediction type": (
        lambda f: edit_json(f / "scheduler/scheduler_config.json", prediction_type="flow"),
        "scheduler",
    ),
    "tokenizer empty": (
        lambda f: [path.unlink() for path in (f / "tokenizer").iterdir()],
        "tokenizer: has neither",
    ),
    "tokenizer of another model": (lambda f: edit_json(f / "text_encoder/config.json", vocab_size=9), "text_encoder"),
    "tokenizer without words": (without_words, "tokenizer: "),
    "class a list": (lambda f: edit_json(f / "model_index.json", unet=["diffusers", ["x"]]), "has no unet"),
    "class a number": (lambda f: edit_json(f / "model_index.json", scheduler=["diffusers", 5]), "has no scheduler"),
    "class a text": (lambda f: edit_json(f / "model_index.json", scheduler=["diffusers", "__doc__"]), "scheduler"),
    "nested deeply": (lambda f: (f / "model_index.json").write_text("[" * 99_999), "not readable JSON"),
    "conventions": (lambda f: (f / "fd_mitsuba.json").write_text('{"view_gird": 2}'), "fd_mitsuba.json: view_gird"),
    "grid": (lambda f: (f / "fd_mitsuba.json").write_text('{"view_grid": 3}'), "does not divide"),
    "base": (lambda f: (f / "fd_mitsuba.json").write_text('{"needs_base": true}'), "4 input channels"),
    "difference": (
        lambda f: (f / "fd_mitsuba.json").write_text('{"predicts": "difference"}'),
        "fd_mitsuba.json: predicts difference",
    ),
}


BAD |= {
    f"weight_map {places!r}": (partial(spread, places=places), "index.json: its weight_map does not say")
    for places in (None, {}, ["a"], {"a": 5})
}
BAD |= {
    f"{name} {key} {value!r}": (partial(set_entry, name=name, key=key, value=value), f"{name}: {key} is {value!r}")
    for name, key, values in (
        ("unet/config.json", "sample_size", (3.5, {"a": 1}, -8, "64", [16], [16, "x"], True)),
        ("unet/config.json", "block_out_channels", ("big", [], [32, "x"], [0, 32], 5)),
        ("vae/config.json", "block_out_channels", ("big", [], [[8]])),
        ("vae/config.json", "layers_per_block", ("two", 0, None)),
        ("vae/config.json", "scaling_factor", ("x", None, 0.0, -1, float("nan"), float("inf"))),
        ("vae/config.json", "shift_factor", ("x", float("nan"))),
        ("scheduler/scheduler_config.json", "num_train_timesteps", (1, 0, -5, 2.5, "x", None)),
    )
    for value in values
}


@pytest.mark.parametrize("case", BAD)
def test_bad_folder_is_one_line(folders: dict[str, Path], tmp_path: Path, case: str) -> None:
    spoil, expected = BAD[case]
    folder = shutil.copytree(folders["sd15"], tmp_path / "model")
    spoil(folder)
    with pytest.raises(UserError) as caught:
        DiffusionGuidance.load(GuidanceConfig(model=str(folder)))
    message = str(caught.value)
    assert expected in message and str(folder) in message
    assert "\n" not in message and len(message) < 500


HEADERS = (
    *("no index", "wrong class", "no weights", "pickle only", "weights cut short", "depth", "grid", "base"),
    *("prediction type", "difference"),
)


@pytest.mark.parametrize("case", HEADERS)
def test_what_headers_tell_is_told_without_loading(folders: dict[str, Path], tmp_path: Path, case: str) -> None:
    spoil, expected = BAD[case]
    folder = shutil.copytree(folders["sd15"], tmp_path / "model")
    config = RunConfig.load(None, [f"guidance.model={folder}"])
    check_model(config, True, True)
    spoil(folder)
    with pytest.raises(UserError) as told:
        check_model(config, True, True)
    with pytest.raises(UserError) as refused:
        DiffusionGuidance.load(config.guidance)
    assert str(told.value) == str(refused.value) and expected in str(told.value)


@pytest.mark.parametrize(
    ("model", "expected"),
    [("/no/such/folder", "no such folder"), ("some-name", "no such folder"), ("owner/name", "HF_HUB_OFFLINE")],
)
def test_unknown_model_names(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, model: str, expected: str) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(UserError, match=expected):
        loading.locate(model)


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.touch()
    with pytest.raises(UserError, match="is a file"):
        loading.locate(str(path))


def test_hub_id_in_the_cache_loads_offline(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    repository = tmp_path / "models--owner--name"
    shutil.copytree(folders["sd15"], repository / "snapshots" / "0123456789abcdef")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("0123456789abcdef")
    assert DiffusionGuidance.load(GuidanceConfig(model="owner/name")).picture_size("coarse") == 16


def test_hub_failures_and_half_precision_repositories(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    asked: list[list[str]] = []

    def only_half(model: str, allow_patterns: list[str], ignore_patterns: list[str], **_: object) -> str:
        asked.append(ignore_patterns)
        (tmp_path / "model_index.json").touch()
        return str(tmp_path)

    monkeypatch.setattr("huggingface_hub.snapshot_download", only_half)
    assert loading.locate("owner/half") == tmp_path
    assert "*.fp16.*" in asked[0] and "*.fp16.*" not in asked[1] and len(asked) == 2
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: folders["sd15"])
    assert loading.locate("owner/whole") == folders["sd15"]

    def unknown(*_: object, **__: object) -> str:
        raise OSError("404 Client Error.\n\nRepository Not Found for url")

    monkeypatch.setattr("huggingface_hub.snapshot_download", unknown)
    with pytest.raises(UserError, match="owner/none: neither a folder here nor fetched .*404 Client Error"):
        loading.locate("owner/none")


def test_half_precision_files_are_found(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = tmp_path / "half"
    pipeline = diffusers.StableDiffusionPipeline.from_pretrained(folders["sd15"], safety_checker=None)
    pipeline.save_pretrained(folder, variant="fp16")
    guidance = load(folder)
    assert next(guidance.components.unet.parameters()).dtype == torch.float32
    assert gradient_of(guidance, views_for(guidance, "coarse", 1), "coarse").isfinite().all()


def test_builtin_is_a_folder_like_any_other(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "builtin_folder", lambda _: builtin.builtin_folder(folders["ip2p"]))
    assert DiffusionGuidance.load(GuidanceConfig()).needs_base


def test_too_little_memory_is_told_before_loading(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda device: 5_000_000)
    monkeypatch.setattr(loading, "_load", lambda *_: pytest.fail("loaded all the same"))
    with pytest.raises(UserError, match=r"needs about 0\.\d\d GB .* has 0\.01 GB left; lower guidance\.views_per_call"):
        DiffusionGuidance.load(GuidanceConfig(model=str(folders["sd15"])))


def test_a_renderer_on_the_same_card_is_left_its_share(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_bytes", lambda _: 8_000_000_000)
    monkeypatch.setattr(memory, "renders_on_card", lambda: True)
    memory.require_memory(4_000_000_000, 3_500_000_000, "cpu", "model")
    memory.require_memory(4_000_000_000, 2_900_000_000, "cuda", "model")
    with pytest.raises(UserError, match="4.50 GB to work in"):
        memory.require_memory(4_000_000_000, 3_500_000_000, "cuda", "model")


def test_memory_estimate_of_stable_diffusion() -> None:
    """Measured with SD 1.5 at 512 x 512: 3.35 GB for a picture to the latents and back, 0.26 GB through the UNet."""
    unet, vae = {"block_out_channels": (320, 640, 1280, 1280)}, {"block_out_channels": (128, 256, 512, 512)}
    for batch, measured in ((1, 3.35 + 0.26), (2, 3.35 + 0.52)):
        estimate = memory.working_set_bytes(unet, vae, 64, batch, "float32")
        assert measured * 0.9 < estimate / 1e9 < measured * 1.2
    assert memory.available_bytes() > 0


def test_cgroup_limit_counts(tmp_path: Path) -> None:
    for name, text in {
        "memory.max": "1000",
        "memory.current": "700",
        "memory.stat": "anon 5\ninactive_file 50",
    }.items():
        (tmp_path / name).write_text(text)
    assert memory._cgroup_available(tmp_path) == 350
    (tmp_path / "memory.max").write_text("max")
    assert memory._cgroup_available(tmp_path) is None


def test_the_tightest_of_nested_cgroups_counts(tmp_path: Path) -> None:
    """A service within a slice: either may have a limit of its own, and the process is told its own path only."""
    own = tmp_path / "cgroup"
    own.write_text("0::/work.slice/run.scope\n")
    for group, limit in (("work.slice", "5000"), ("work.slice/run.scope", "9000")):
        (tmp_path / group).mkdir()
        for name, text in {"memory.max": limit, "memory.current": "1000", "memory.stat": "inactive_file 0"}.items():
            (tmp_path / group / name).write_text(text)
    assert memory._cgroup_available(tmp_path, own) == 4000
    (tmp_path / "work.slice" / "memory.max").write_text("max")
    assert memory._cgroup_available(tmp_path, own) == 8000
    own.write_text("0::/somewhere/else\n")
    assert memory._cgroup_available(tmp_path, own) is None
    assert memory._cgroup_available(tmp_path, tmp_path / "missing") is None


@pytest.mark.parametrize("name", ["count_weights", "load"])
def test_no_memory_is_not_taken_for_a_damaged_file(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError("Cannot allocate memory (os error 12)")

    place = "safetensors.safe_open" if name == "count_weights" else "diffusers.UNet2DConditionModel.from_pretrained"
    monkeypatch.setattr(place, fails)
    with pytest.raises(UserError, match=r"out of memory .*os error 12.*guidance.views_per_call") as caught:
        DiffusionGuidance.load(GuidanceConfig(model=str(folders["sd15"])))
    assert "damaged" not in str(caught.value) and "fetch" not in str(caught.value)


def test_words_are_checked_where_the_tokenizer_knows_whole_words(folders: dict[str, Path]) -> None:
    assert load(folders["sd15"]).set_prompt("a dragon") == []
    components = components_of(folders["sd15"])
    conventions = components.conventions.model_copy(update={"whole_words": True})
    guidance = DiffusionGuidance(replace(components, conventions=conventions), GuidanceConfig())
    assert guidance.set_prompt("a horse with a dragon", "blurry") == ["dragon"]


def test_shape_of_autoencoder_output_is_read_from_its_kind(folders: dict[str, Path]) -> None:
    guidance = load(folders["tiny_vae"])
    assert isinstance(guidance.components.vae, diffusers.AutoencoderTiny)
    latents = guidance.latents
    assert (latents.scaling_factor, latents.shift_factor, latents.vae_scale_factor) == (1.0, 0.0, 8)
    shifted = load(folders["sd15"])
    pictures = views_for(shifted, "refined", 1).pictures.detach()
    with torch.no_grad():
        plain = shifted.encode(pictures, "refined")
        shifted.latents.shift_factor = 0.5
        torch.testing.assert_close(shifted.encode(pictures, "refined"), plain - 0.5 * shifted.latents.scaling_factor)


def test_weights_take_no_gradients(folders: dict[str, Path]) -> None:
    parts = load(folders["sd15"]).components
    for part in (parts.unet, parts.vae, parts.text_encoder):
        assert not part.training and not any(weight.requires_grad for weight in part.parameters())
