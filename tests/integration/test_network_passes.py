"""How often a step runs the network, as the forecast counts it, against the operations that PyTorch itself counts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from tiny_guidance import load
from tiny_pipelines import save_pipeline
from torch.utils.flop_counter import FlopCounterMode

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews, NonFiniteGuidance
from fd_mitsuba.guidance.network_passes import network_passes

# PyTorch counts the operations of the thread that asks, and several would share the pictures out.
pytestmark = pytest.mark.usefixtures("one_thread")
VIEWS, STEPS = 2, 1
PART = {"hat": ("a crown", "horse")}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("passes")
    return {kind: save_pipeline(kind, root / kind) for kind in ("sd15", "ip2p")}


def views_of(guidance: DiffusionGuidance) -> GuidanceViews:
    size = guidance.picture_size("coarse")
    pictures, base = torch.rand(2, VIEWS, 5, size, size, generator=torch.Generator().manual_seed(0))
    regions = {"hat": torch.rand(VIEWS, 1, size, size, generator=torch.Generator().manual_seed(1))}
    return GuidanceViews(pictures.requires_grad_(), base, [0.0] * VIEWS, [20.0] * VIEWS, False, regions)


def operations(guidance: DiffusionGuidance, steps: int) -> float:
    """Of the UNet in coarse steps, whose pictures take no other network; a mean over steps."""
    with FlopCounterMode(display=False) as counter:
        for step in range(steps):
            views = views_of(guidance)
            guidance.guide(views, step, steps, "coarse", seed=3).loss.backward()
    return counter.get_total_flops() / steps


def of_one_pass(guidance: DiffusionGuidance) -> float:
    """Operations of one picture through the UNet alone."""
    unet, texts = guidance.components.unet, guidance.texts.embed(["a horse"])
    picture = torch.zeros(1, unet.config.in_channels, guidance.latent_size, guidance.latent_size)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        unet(picture, torch.tensor([5]), texts)
    return counter.get_total_flops()


CASES: list[tuple[str, dict[str, object], Mapping[str, tuple[str, str]], float]] = [
    ("sd15", {"variant": "sds"}, {}, 2),
    ("sd15", {"variant": "sds", "guidance_scale": 1.0}, {}, 1),
    ("sd15", {"variant": "csd"}, {}, 2),
    ("sd15", {"variant": {"kind": "reconstruction", "steps": 3}}, {}, 6),
    ("sd15", {"variant": "sds", "perp_neg": 1.0}, {}, 3),
    ("sd15", {"variant": "sds"}, PART, 4),
    ("sd15", {"variant": "sds"}, {"hat": ("a crown", "")}, 3),
    ("sd15", {"variant": "sds", "perp_neg": 1.0}, PART, 5),
    ("ip2p", {"variant": "sds", "image_guidance_scale": 1.5}, {}, 3),
    ("sd15", {"variant": "vsd"}, {}, 5),
]


@pytest.mark.parametrize(("kind", "settings", "parts", "expected"), CASES)
def test_every_pass_is_counted(
    folders: dict[str, Path],
    kind: str,
    settings: dict[str, object],
    parts: Mapping[str, tuple[str, str]],
    expected: float,
) -> None:
    guidance = load(folders[kind], **settings)
    guidance.set_part_prompts(parts)
    config, negatives = GuidanceConfig(**settings), [negative for _, negative in parts.values()]
    given = kind == "ip2p", VIEWS, "blurry", negatives
    assert network_passes("coarse", config, AppearanceConfig(), *given) == pytest.approx(expected)
    measured = operations(guidance, STEPS) / (VIEWS * of_one_pass(guidance))
    assert measured == pytest.approx(expected, rel=0.05)


def test_a_part_that_is_all_there_is_costs_no_pass_more(folders: dict[str, Path]) -> None:
    """Its gradient is that of the part's own prompts, set for all; the scene's prompt would go unheard."""
    guidance, alone = (load(folders["ip2p"], variant="sds", image_guidance_scale=1.0) for _ in range(2))
    guidance.set_part_prompts(PART)
    alone.set_prompt(*PART["hat"])
    gradients = []
    for asked in (guidance, alone):
        views = views_of(asked)
        views.regions["hat"].fill_(1.0)  # pyright: ignore
        with FlopCounterMode(display=False) as counter:
            result = asked.guide(views, 0, STEPS, "coarse", seed=3)
        gradients.append(torch.autograd.grad(result.loss, views.pictures)[0])
        assert counter.get_total_flops() / (VIEWS * of_one_pass(asked)) == pytest.approx(2, rel=0.05)
    assert torch.equal(*gradients)


def test_weights_that_are_no_numbers_are_named(folders: dict[str, Path]) -> None:
    for name in ("unet", "text_encoder"):
        guidance = load(folders["sd15"])
        values = next(getattr(guidance.components, name).parameters()).detach()
        kept = values.clone()
        values.fill_(torch.nan)
        with pytest.raises(NonFiniteGuidance, match=rf"{name}: its weights have a NaN or an infinity; copy or fetch"):
            guidance.guide(views_of(guidance), 0, STEPS, "coarse", seed=3)
        values.copy_(kept)  # other tests share them


@pytest.mark.parametrize(("bounds", "most"), [((0.02, 0.98), 2), ((0.02, 0.98), 8), ((0.02, 0.35), 8)])
def test_the_inversion_of_ism_is_counted_on_average(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, bounds: tuple[float, float], most: int
) -> None:
    """Its length follows the timesteps that are drawn: 40 steps, of which the forecast gives the mean."""
    settings = {"variant": "ism", "timestep_range_coarse": bounds, "views_per_call": most}
    guidance = load(folders["sd15"], **settings)
    seen: list[int] = []

    def counted(pictures: torch.Tensor, *others: object, **more: object) -> tuple[torch.Tensor]:
        seen.append(len(pictures))
        return (torch.zeros_like(pictures),)  # what the network says does not change how often it is asked

    monkeypatch.setattr(guidance.components.unet, "forward", counted)
    for step in range(40):
        guidance.guide(views_of(guidance), step, 40, "coarse", seed=3)
    forecast = network_passes("coarse", GuidanceConfig(**settings), AppearanceConfig(), False, VIEWS)
    assert sum(seen) / (40 * VIEWS) == pytest.approx(forecast, rel=0.08) and forecast > 3
