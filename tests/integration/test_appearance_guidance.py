"""Guidance of colour pictures, on pipelines of Stable Diffusion's layout and on the built-in prior's."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_guidance import components_of
from tiny_pipelines import save_pipeline

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance import builtin, loading
from fd_mitsuba.guidance.diffusion import MASK_THRESHOLD, DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews, NonFiniteGuidance
from fd_mitsuba.prior.training.kinds import APPEARANCE
from fd_mitsuba.prior.training.model import build_tokenizer
from fd_mitsuba.prior.training.pack import pack

KINDS = ("sd15", "sd21", "ip2p", "tiny_vae", "builtin")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Random weights throughout; `builtin` is a packed checkpoint of the appearance prior."""
    root = tmp_path_factory.mktemp("pipelines")
    made = {kind: save_pipeline(kind, root / kind) for kind in KINDS[:-1]}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        modules = APPEARANCE.build_modules(build_tokenizer())
    average = {key: value for key, value in modules.state_dict().items() if value.is_floating_point()}
    torch.save({"average": average, "kind": "appearance"}, root / "checkpoint.pt")
    pack(root / "checkpoint.pt", root / "builtin")
    return made | {"builtin": root / "builtin"}


def load(folder: Path, variant: str = "sds", **appearance: object) -> DiffusionGuidance:
    config = GuidanceConfig(model=str(folder), variant=variant)
    guidance = DiffusionGuidance(components_of(folder), config, appearance=AppearanceConfig(**appearance))
    guidance.set_prompt("a horse with wings")
    return guidance


def views_of(guidance: DiffusionGuidance, count: int = 4, size: int | None = None, seed: int = 0) -> AppearanceViews:
    """A part in the left third of every view, on an object that fills it but for a black rim."""
    size = size or guidance.appearance_size
    generator = torch.Generator().manual_seed(seed)
    pictures, condition = torch.rand(2, count, 3, size, size, generator=generator)
    mask, part = torch.zeros(2, count, 1, size, size)
    mask[..., size // 8 :, :] = 1
    part[..., size // 4 : size // 2, : size // 4] = 1
    azimuths = [10.0 + 90 * index for index in range(count)]
    pictures, shine = (pictures * mask).requires_grad_(), (0.3 * part).requires_grad_()
    return AppearanceViews(pictures, condition * mask, mask, part, shine, azimuths, [20.0] * count)


def gradient_of(guidance: DiffusionGuidance, views: AppearanceViews, step: int = 0, seed: int = 3) -> torch.Tensor:
    return torch.autograd.grad(guidance.guide_appearance(views, step, 10, seed).loss, views.pictures)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_every_pipeline_guides(folders: dict[str, Path], kind: str) -> None:
    guidance = load(folders[kind], guidance_scale=7.5)
    assert guidance.appearance_size == (32 if kind == "builtin" else 128)
    assert guidance.needs_base == (kind in ("ip2p", "builtin"))
    views = views_of(guidance)
    result = guidance.guide_appearance(views, 0, 10, 3)
    (gradient,) = torch.autograd.grad(result.loss, views.pictures)
    assert math.isfinite(result.loss.item()) and gradient.isfinite().all() and gradient.abs().max() > 0
    assert gradient_of(guidance, views).equal(gradient) and not gradient_of(guidance, views, step=1).equal(gradient)


@pytest.mark.parametrize("variant", ["csd", "ism", "reconstruction"])
@pytest.mark.parametrize("kind", ["builtin", pytest.param("sd15", marks=pytest.mark.slow)])
def test_every_variant_guides_three_steps(folders: dict[str, Path], kind: str, variant: str) -> None:
    guidance = load(folders[kind], variant, guidance_scale=3.0)
    views = views_of(guidance)
    gradients = [gradient_of(guidance, views, step) for step in range(3)]
    assert all(gradient.isfinite().all() and gradient.abs().max() > 0 for gradient in gradients)
    assert gradient_of(guidance, views, 0).equal(gradients[0]) and not gradients[1].equal(gradients[0])
    if kind == "builtin":
        assert (gradients[0].abs()[views.part_mask.expand_as(gradients[0]) == 0] == 0).all()


def test_a_real_model_serves_both_stages_from_one_copy(folders: dict[str, Path]) -> None:
    geometry = DiffusionGuidance(components_of(folders["sd15"]), GuidanceConfig(model=str(folders["sd15"])))
    both = geometry.for_appearance(AppearanceConfig(guidance_scale=3.0))
    assert both.components.unet is geometry.components.unet and both.appearance.guidance_scale == 3.0
    both.set_prompt("a horse with wings")
    views = views_of(both)
    assert gradient_of(both, views).equal(gradient_of(load(folders["sd15"], guidance_scale=3.0), views))


@pytest.mark.parametrize("kind", ["builtin", "sd15", "ip2p"])
def test_a_masked_gradient_stays_on_the_part(folders: dict[str, Path], kind: str) -> None:
    masked, free = (load(folders[kind], mask_guidance=choice) for choice in (True, False))
    views = views_of(masked)
    inside, everywhere = gradient_of(masked, views).abs(), gradient_of(free, views).abs()
    part = views.part_mask.expand_as(inside) > 0
    assert inside[part].mean() > 0 and everywhere[~part].mean() > 0.2 * everywhere[part].mean()
    if kind == "builtin":  # its latents are means of disjoint cells
        assert (inside[~part] == 0).all()
    else:  # a VAE sees a surrounding of each cell
        assert inside[~part].mean() < 0.3 * inside[part].mean()


@pytest.mark.parametrize("kind", ["builtin", "ip2p"])
def test_only_a_model_that_knows_shine_is_told_of_it_and_asks_for_it(folders: dict[str, Path], kind: str) -> None:
    guidance = load(folders[kind])
    views = views_of(guidance)
    result = guidance.guide_appearance(views, 0, 10, 3)
    of_pictures, of_shine = torch.autograd.grad(result.loss, (views.pictures, views.shine), allow_unused=True)
    if kind == "ip2p":
        assert of_shine is None
        return
    assert of_shine[views.part_mask > 0].abs().mean() > 0 and (of_shine[views.part_mask == 0] == 0).all()
    other = replace(views, shine=views.shine * 2)
    assert not gradient_of(guidance, other).equal(of_pictures)


def test_a_part_out_of_sight_gives_no_gradient(folders: dict[str, Path]) -> None:
    guidance = load(folders["builtin"])
    guidance.config = guidance.config.model_copy(update={"normalise_gradient": True})
    views = views_of(guidance)
    views.part_mask.zero_()
    assert (gradient_of(guidance, views) == 0).all()
    views.part_mask[0, 0, 0, 0] = MASK_THRESHOLD
    seen = gradient_of(guidance, views)
    assert (seen != 0).any() and (seen[1:] == 0).all()


def test_area_means_equal_the_packed_vae(folders: dict[str, Path]) -> None:
    guidance = load(folders["builtin"])
    mosaic = torch.rand(2, 4, 512, 512, generator=torch.Generator().manual_seed(1))
    mosaic[:, 3] = 0  # the VAE knows no shine
    with torch.no_grad():
        direct = guidance.encode(mosaic, "appearance")
        encoded = guidance.components.vae.encode(2 * mosaic[:, :3] - 1).latents
    assert direct.shape == (2, 4, 64, 64)
    torch.testing.assert_close(direct, encoded, atol=2e-3, rtol=0)  # the folder's weights are half precision


@pytest.mark.parametrize("kind", ["builtin", "sd15"])
def test_pictures_of_another_size_are_resized(folders: dict[str, Path], kind: str) -> None:
    guidance = load(folders[kind], mask_guidance=False)
    small = views_of(guidance)
    double = AppearanceViews(
        *(getattr(small, name).detach().repeat_interleave(2, 2).repeat_interleave(2, 3)
          for name in ("pictures", "condition", "mask", "part_mask", "shine")),
        small.azimuth_deg, small.elevation_deg,
    )  # fmt: skip
    double.pictures.requires_grad_()
    whole, parts = gradient_of(guidance, small), gradient_of(guidance, double)
    assert parts.shape[-1] == 2 * whole.shape[-1] and parts.isfinite().all()
    if kind == "builtin":
        torch.testing.assert_close(torch.nn.functional.avg_pool2d(parts, 2) * 4, whole, atol=1e-5, rtol=1e-3)


def test_the_condition_and_the_prompt_matter(folders: dict[str, Path]) -> None:
    guidance = load(folders["builtin"], guidance_scale=7.5)
    views = views_of(guidance)
    before = gradient_of(guidance, views)
    assert guidance.prompts(views)[0] == "a horse with wings, azimuth0"
    views.condition.mul_(0.5)
    changed = gradient_of(guidance, views)
    assert not changed.equal(before)
    guidance.set_prompt("a horse with golden wings")
    assert not gradient_of(guidance, views).equal(changed)


def test_bad_views_are_refused(folders: dict[str, Path]) -> None:
    guidance = load(folders["builtin"])
    views = views_of(guidance)
    bare = replace(views, condition=None)
    with pytest.raises(ValueError, match="needs the base's pictures"):
        guidance.guide_appearance(bare, 0, 10, 0)
    with pytest.raises(ValueError, match="part_mask must be"):
        replace(views, part_mask=views.mask[:1])
    views.pictures.data[0, 0, 0, 0] = math.nan
    with pytest.raises(NonFiniteGuidance, match="appearance phase are not finite"):
        guidance.guide_appearance(views, 0, 10, 0)


def test_builtin_means_the_colours_prior_in_this_stage(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(loading, "builtin_folder", lambda path: asked.append(path) or folders["builtin"])
    guidance = DiffusionGuidance.load(GuidanceConfig(), appearance=AppearanceConfig(guidance_scale=3.0))
    DiffusionGuidance.load(GuidanceConfig())
    assert asked == [builtin.APPEARANCE_FOLDER, builtin.BUILTIN_FOLDER]
    assert guidance.conventions.condition == "clay" and guidance.conventions.background == "black"
    assert guidance.set_prompt("a horse with red wings") == []
