"""Painting a part by guidance, with a network whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance.colour_latents import colour_latents
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.prior.judging.paint_check import paint
from fd_mitsuba.prior.training.kinds import APPEARANCE
from fd_mitsuba.prior.training.model import build_tokenizer
from fd_mitsuba.prior.training.pack import pack


class _Green(torch.nn.Module):
    """Takes every picture for a noisy one of plain green metal."""

    dtype = torch.float32

    def __init__(self, like: torch.nn.Module) -> None:
        super().__init__()
        self.config = like.config

    def forward(self, inputs: torch.Tensor, t: torch.Tensor, **_: object) -> tuple[torch.Tensor]:
        green = torch.tensor([0.1, 0.5, 0.15, 0.9]).view(1, 4, 1, 1).expand(len(inputs), 4, 64, 64)
        return (colour_latents(green, 64),)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("prior")
    modules = APPEARANCE.build_modules(build_tokenizer())
    average = {key: value for key, value in modules.state_dict().items() if value.is_floating_point()}
    torch.save({"average": average, "kind": "appearance"}, root / "checkpoint.pt")
    pack(root / "checkpoint.pt", root / "weights")
    return root / "weights"


def test_a_part_takes_the_colour_and_the_shine_that_the_network_sees(folder: Path) -> None:
    settings = AppearanceConfig(weighting="sds", guidance_scale=1.0, timestep_range=(0.3, 0.7))
    config = GuidanceConfig(model=str(folder), normalise_gradient=True)
    guidance = DiffusionGuidance.load(config, appearance=settings)
    guidance.components = replace(guidance.components, unet=_Green(guidance.components.unet))
    before, after = (paint(guidance, "cat", "top hat", "a cat with a green top hat", 0, steps) for steps in (0, 40))
    assert before.nearest != "green" and after.nearest == "green"
    red, green, blue = after.seen
    assert green > 1.3 * red and green > 1.3 * blue
    assert before.metallic < 0.1 < after.metallic - 0.2 and after.roughness < before.roughness - 0.2
    assert len(after.pictures) == 5 and after.pictures[0].shape == (3, 128, 128)
    assert after.speckle < 25
