"""What the built-in prior draws at once, named by a judge that shares nothing with it, and the way towards it."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.evaluation.part_judge import load_judge
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.drafter import TOLERANCE, DiffusionDrafter
from fd_mitsuba.guidance.interface import Drawn, GuidanceViews
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.views import CameraBatch

SNOWMAN = Path(__file__).resolve().parents[2] / "scenes/snowman/scene.xml"


@pytest.fixture(scope="module")
def guidance() -> DiffusionGuidance:
    made = DiffusionGuidance.load(GuidanceConfig(model="builtin"))
    made.set_prompt("a snowman with a pointed hat")
    return made


@pytest.fixture(scope="module")
def views() -> GuidanceViews:
    """Two mosaics of the snowman's head and what is above it."""
    mesh = load_edit_scene(SNOWMAN).base_canonical
    azimuth = np.concatenate([start + 90.0 * np.arange(4) for start in (0.0, 45.0)])
    cameras = CameraBatch.around(azimuth, 20.0, 3.0, 22.0, np.array([0.0, 0.75, 0.0]))
    vertices, faces = torch.tensor(mesh.vertices).float(), torch.tensor(mesh.faces).long()
    base = GeometryPass(32, 4, 1, "camera").render_primal(vertices, faces, torch.zeros(len(vertices)), cameras, 0)
    return GuidanceViews(base, base, cameras.azimuth_deg, cameras.elevation_deg, True)


def test_it_draws_what_the_prompt_says(guidance: DiffusionGuidance, views: GuidanceViews) -> None:
    drawn = guidance.drafter.draw(views, 3)
    assert drawn.latents.shape == (2, 4, 64, 64) and drawn.part.shape == (8, 32, 32)
    above = views.base[:, 3] < 0.01
    there = (drawn.latents.reshape(2, 4, 2, 32, 2, 32).permute(0, 2, 4, 1, 3, 5).reshape(8, 4, 32, 32))[:, 3] > 0
    assert (drawn.part[above & there] > 0.5).float().mean() > 0.9  # what is where nothing was is the part
    assert drawn.part[~there].max() == 0 and 0.02 < drawn.part.mean() < 0.4
    after = drawn.latents.numpy().reshape(2, 4, 2, 32, 2, 32).transpose(0, 2, 4, 1, 3, 5).reshape(8, 4, 32, 32)
    before = torch.cat([views.base[:, :3], 2 * views.base[:, 3:4] - 1], 1).numpy()
    judge = load_judge()
    said = judge(before, after)
    named = [judge.classes[k] for k in said.argmax(1)]
    assert named.count("pointed hat") >= 5, named


def test_without_a_scale_of_its_own_the_text_says_nothing(guidance: DiffusionGuidance, views: GuidanceViews) -> None:
    drawn = {}
    for scale in (0.0, 3.0):
        for prompt in ("a snowman with a pointed hat", "a snowman with wings"):
            other = copy.copy(guidance)
            other.conventions = guidance.conventions.model_copy(update={"draft_scale": scale})
            other.set_prompt(prompt)
            drawn[scale, prompt] = DiffusionDrafter(other).draw(views, 3).latents
    guidance.set_prompt("a snowman with a pointed hat")
    (same, twin), (hat, wings) = (list(drawn.values())[k : k + 2] for k in (0, 2))
    assert torch.equal(same, twin) and (hat - wings).abs().mean() > 0.01


def test_the_seed_decides_what_is_drawn(guidance: DiffusionGuidance, views: GuidanceViews) -> None:
    first, again, other = (guidance.drafter.draw(views, seed).latents for seed in (3, 3, 4))
    assert torch.equal(first, again) and (first - other).abs().mean() > 0.01


def test_the_gradient_leads_to_what_was_drawn(guidance: DiffusionGuidance, views: GuidanceViews) -> None:
    """Against the formula, written out by hand, in each of its three cases; a step's is the mean over mosaics."""
    base = torch.cat([views.base[:, :3], 2 * views.base[:, 3:4] - 1], 1)
    tiles = base.reshape(2, 2, 2, 4, 32, 32).permute(0, 3, 1, 4, 2, 5).reshape(2, 4, 64, 64)
    wanted = tiles.clone()
    wanted[0, 0, 5, 7] -= 4 * TOLERANCE  # far: as far as a gradient reaches
    wanted[0, 1, 5, 7] += 1.5 * TOLERANCE  # half as far
    wanted[1, 2, 9, 9] += 0.9 * TOLERANCE  # within what a copy is off by
    pictures = views.base.clone().requires_grad_()
    result = guidance.drafter.guide(pictures, Drawn(wanted, torch.zeros(8, 32, 32), 0.25), slice(0, 2))
    result.loss.backward()
    expected = torch.zeros_like(tiles)
    expected[0, 0, 5, 7], expected[0, 1, 5, 7] = 1 / 0.25 / 2, -0.5 / 0.25 / 2
    got = pictures.grad[:, :3]
    got = got.reshape(2, 2, 2, 3, 32, 32).permute(0, 3, 1, 4, 2, 5).reshape(2, 3, 64, 64)
    assert torch.allclose(got, expected[:, :3], atol=1e-5)
    assert torch.equal(result.preview, wanted)


def test_a_model_that_does_not_see_the_base_draws_nothing(tmp_path: Path) -> None:
    from tiny_pipelines import save_pipeline

    assert DiffusionGuidance.load(GuidanceConfig(model=str(save_pipeline("sd15", tmp_path / "sd")))).drafter is None
