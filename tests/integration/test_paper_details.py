"""Settings for what the paper leaves open or its authors do otherwise, against the same computed by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_guidance import load
from tiny_pipelines import save_pipeline

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews
from fd_mitsuba.guidance.normal_augmentation import random_turns, turned
from fd_mitsuba.guidance.step_draws import step_generator


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("details")
    return {kind: save_pipeline(kind, root / kind) for kind in ("sd15", "ip2p")}


def views_for(guidance: DiffusionGuidance, phase: str, count: int = 2) -> GuidanceViews:
    size, generator = guidance.picture_size(phase), torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(2, count, 3, size, size, generator=generator), dim=2)
    mask = (torch.rand(2, count, 1, size, size, generator=generator) > 0.4).float()
    pictures, base = torch.cat([normals * mask, mask, mask], dim=2)
    return GuidanceViews(pictures.requires_grad_(), base, [0.0] * count, [20.0] * count)


def gradient_of(guidance: DiffusionGuidance, views: GuidanceViews, phase: str = "coarse") -> torch.Tensor:
    return torch.autograd.grad(guidance.guide(views, 0, 10, phase, seed=3).loss, views.pictures)[0]


def test_packed_priors_keep_the_mask_that_they_were_trained_with(folders: dict[str, Path]) -> None:
    assert DiffusionGuidance.load(GuidanceConfig()).latents.signed_mask
    assert not load(folders["sd15"]).latents.signed_mask
    assert load(folders["sd15"], mask_channel="signed").latents.signed_mask


@pytest.mark.parametrize(("background", "value"), [("black", -1.0), ("grey", 0.0), ("white", 1.0)])
def test_normals_before_a_background(folders: dict[str, Path], background: str, value: float) -> None:
    guidance = load(folders["sd15"], refined_background=background)
    pictures = views_for(guidance, "refined", 1).pictures.detach()
    seen = torch.where(pictures[:, 3:4] > 0, pictures[:, :3], torch.tensor(value))
    with torch.no_grad():
        expected = guidance.components.vae.encode(seen).latent_dist.mean * 0.18215
        torch.testing.assert_close(guidance.encode(pictures, "refined"), expected, rtol=1e-4, atol=1e-5)


def test_the_sum_is_as_many_times_the_mean_as_there_are_pictures(folders: dict[str, Path]) -> None:
    mean, total = (load(folders["sd15"], reduction=name) for name in ("mean", "sum"))
    views = views_for(mean, "coarse", 3)
    torch.testing.assert_close(gradient_of(total, views), 3 * gradient_of(mean, views), rtol=1e-5, atol=1e-6)


def test_turns_are_evenly_distributed_rotations() -> None:
    generator = torch.Generator().manual_seed(0)
    turns = random_turns(20000, "rotation", generator)
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand_as(turns), rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(20000), rtol=0, atol=1e-5)
    assert turns.mean(0).abs().max() < 0.02, "no direction is preferred"
    torch.testing.assert_close(turns.square().mean(0), torch.full((3, 3), 1 / 3), rtol=0, atol=0.01)
    angle = ((turns.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1).acos()
    assert abs(float(angle.mean()) - (torch.pi / 2 + 2 / torch.pi)) < 0.02, "of the Haar measure"
    flipped = random_turns(20000, "rotation_flip", generator)
    assert abs(float((torch.linalg.det(flipped) < 0).float().mean()) - 0.5) < 0.02


@pytest.mark.parametrize("kind", ["sd15", "ip2p"])
def test_an_augmented_step_is_a_plain_one_of_turned_normals(folders: dict[str, Path], kind: str) -> None:
    """The base is turned alike, the gradient comes back turned, and the refined phase has none of it."""
    plain = load(folders[kind], guidance_scale=7.5)
    augmented = load(folders[kind], guidance_scale=7.5, normal_augmentation="rotation_flip")
    views = views_for(plain, "coarse")
    turns = random_turns(2, "rotation_flip", step_generator(3, 0, "coarse", 1))
    inside = replace(
        views,
        pictures=turned(views.pictures.detach(), turns).requires_grad_(),
        base=turned(views.base, turns),
    )
    expected = gradient_of(plain, inside)
    expected = torch.cat([torch.einsum("bij,bihw->bjhw", turns, expected[:, :3]), expected[:, 3:]], dim=1)
    torch.testing.assert_close(gradient_of(augmented, views), expected, rtol=1e-4, atol=1e-6)
    refined = views_for(plain, "refined", 1)
    assert gradient_of(augmented, refined, "refined").equal(gradient_of(plain, refined, "refined"))


def test_a_soft_mask_is_the_parts_share_of_each_cell(folders: dict[str, Path]) -> None:
    """g = share (e_hat(sqrt(a) z + sqrt(1 - a) share e) - share e) w, by the network itself."""
    settings = AppearanceConfig(soft_mask=True, guidance_scale=1.0, weighting="uniform")
    guidance = load(folders["sd15"], settings, view_prompts=False)
    colours = torch.rand(1, 3, 128, 128, generator=torch.Generator().manual_seed(1)).requires_grad_()
    part = torch.zeros(1, 1, 128, 128)
    part[..., 20:60, 10:75] = 1
    views = AppearanceViews(colours, None, part, part, part, [0.0], [0.0])
    t, noise = guidance.draws.of_step(1, 0, 10, "appearance", 3)
    a = guidance.alpha_bars[t]
    share = part.view(1, 1, 16, 8, 16, 8).mean(dim=(3, 5))
    assert 0 < float(share[share > 0].min()) < 1
    z = guidance.encode(colours, "appearance")
    with torch.no_grad():
        z_t = a.sqrt() * z + (1 - a).sqrt() * noise * share
        seen = guidance.components.unet(z_t, t, guidance.texts.embed(["a horse with wings"])).sample
    expected = torch.autograd.grad(z, colours, share * (seen - share * noise))[0]
    got = torch.autograd.grad(guidance.guide_appearance(views, 0, 10, 3).loss, colours)[0]
    assert (got - expected).abs().max() < 1e-4 * expected.abs().max()
