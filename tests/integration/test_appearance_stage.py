"""Behaviour of the appearance stage with a guidance that is known in closed form: a colour that it asks for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import BASE

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceResult
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.runs.preservation import measure_preservation
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.training.appearance_stage import AppearanceStage
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.record import read_metrics
from fd_mitsuba.viewing.lit_views import ring_cameras

RED = torch.tensor([0.9, 0.1, 0.1]).view(1, 3, 1, 1)


class AskForColour:
    """Wants the pixels that show the part to be one sRGB colour."""

    needs_base = False
    view_grid = 1
    appearance_size = 24

    def __init__(self, colour: torch.Tensor) -> None:
        self.colour = colour

    def guide_appearance(self, views: AppearanceViews, step: int, steps_total: int, seed: int) -> GuidanceResult:
        wrong = (views.pictures - self.colour).square() * views.part_mask
        return GuidanceResult(wrong.sum() / views.part_mask.sum().clamp(min=1))


class AskForShine(AskForColour):
    """Wants the part to be a mirror, and does not care for its colour."""

    def guide_appearance(self, views: AppearanceViews, step: int, steps_total: int, seed: int) -> GuidanceResult:
        wrong = (views.shine - views.part_mask).square().sum() / views.part_mask.sum().clamp(min=1)
        return GuidanceResult(wrong + 0 * views.pictures.sum())


@pytest.fixture
def scene(make_scene: Callable[..., Path]) -> EditScene:
    return load_edit_scene(make_scene())


@pytest.fixture
def lump(scene: EditScene) -> SimpleNamespace:
    """A ball that sits on the animal's back, sunk in a little."""
    vertices, faces = unit_sphere()
    top = scene.base_canonical.vertices[:, 1].max()
    return SimpleNamespace(vertices=0.25 * np.asarray(vertices) + [0, 0.5 * top + 0.2, 0], faces=np.asarray(faces))


def settings(**appearance: object) -> RunConfig:
    values = {"steps": 40, "views": 2, "spp": 2, "background": "black", "learning_rate": 2e-2, "exposure": 1.0}
    texture = {"levels": 4, "finest_resolution": 16, "log2_table": 12}
    return RunConfig.model_validate({"appearance": {**values, **appearance}, "texture": texture, "seed": 3})


def trained(scene: EditScene, lump: SimpleNamespace, **appearance: object) -> AppearanceStage:
    stage = AppearanceStage(scene, settings(**appearance), {"part": lump}, AskForColour(RED), lambda line: None)
    for step in range(stage.steps):
        stage.step(step)
    return stage


def mean_colour(stage: AppearanceStage) -> torch.Tensor:
    figures = stage.check_field(0)
    return torch.tensor([figures["mean_red"], figures["mean_green"], figures["mean_blue"]])


def test_the_part_takes_the_colour_that_is_asked_for(scene: EditScene, lump: SimpleNamespace) -> None:
    red, green, blue = mean_colour(trained(scene, lump))
    assert red > 2.5 * green and red > 2.5 * blue


@pytest.mark.parametrize("fixed", [[], ["metallic"]])
def test_a_part_that_is_asked_to_shine_becomes_smooth_metal(
    scene: EditScene, lump: SimpleNamespace, fixed: list[str]
) -> None:
    stage = AppearanceStage(scene, settings(fixed=fixed), {"part": lump}, AskForShine(RED), lambda line: None)
    before = stage.check_field(0)
    for step in range(stage.steps):
        stage.step(step)
    after = stage.check_field(0)
    if fixed:  # roughness alone cannot make metal of it, and is left alone
        assert after["mean_roughness"] == pytest.approx(before["mean_roughness"], abs=1e-3)
    else:
        assert after["mean_roughness"] < before["mean_roughness"] - 0.1
        assert after["mean_metallic"] > before["mean_metallic"] + 0.1


def test_normals_do_not_lean_to_the_light_where_bends_have_a_price(scene: EditScene, lump: SimpleNamespace) -> None:
    """A part that is asked to be brighter than its material can be leans to the lamp; the price on bends stops that."""
    tilts = {}
    for price in (0.0, 100.0):
        values = settings(lambda_bend=price, steps=25)
        stage = AppearanceStage(scene, values, {"part": lump}, AskForColour(torch.ones(3, 1, 1)), lambda line: None)
        for step in range(stage.steps):
            stage.step(step)
        with torch.no_grad():
            normal = stage.field(stage._points[:1024]).normal
        tilts[price] = float(torch.rad2deg(torch.arccos(normal[:, 2].clamp(max=1))).mean())
    assert tilts[0.0] > 10 and tilts[100.0] < 0.3 * tilts[0.0]


def test_style_consistency_ties_the_part_to_the_base(scene: EditScene, lump: SimpleNamespace) -> None:
    """With it, the colour step across the boundary is at most half of that without; the base here is a grey 0.5."""
    steps = {}
    for style in (False, True):
        stage = trained(scene, lump, style=style, lambda_sds=0.3, boundary_reach=0.08)
        if style:
            boundary = stage.losses.built_in["style_boundary"]
            places, colours = boundary.boundary, boundary.beside.base_color
        steps[style] = stage
    difference = {
        style: float((stage.field(places).base_color - colours).abs().mean().detach()) for style, stage in steps.items()
    }
    assert len(places) > 100
    assert difference[True] < 0.5 * difference[False]


@pytest.mark.usefixtures("one_thread")
def test_the_dual_path_leaves_the_base_and_a_single_path_does_not(scene: EditScene, lump: SimpleNamespace) -> None:
    """Two scenes are built: now and then the acceleration structure of one differs in a last digit."""
    cameras = ring_cameras(4, np.zeros(3))
    drift = {}
    for single in (False, True):
        stage = trained(scene, lump, single_path=single, steps=15)
        gbuffer = stage.rendering.trace(cameras, 0, size=32, spp=4)
        with torch.no_grad():
            after = stage.render(gbuffer, stage.texture(gbuffer), 0)
        alone = AppearancePass(scene, {"part": lump}, stage.shading, 32, 4)
        plain = alone.trace(cameras, 0, size=32, spp=4)
        truth = alone.render_base(plain, 0)
        seen = (plain.base_mask > 0.999).expand(-1, 3, -1, -1)
        picture = after.merged if single else after.base_path
        drift[single] = float((picture - truth)[seen].abs().mean())
    assert drift[False] < 1e-8 and drift[True] > 1e-3  # 3e-10 where a ray meets another last digit


def test_base_pixels_are_those_of_the_base_alone(scene: EditScene, lump: SimpleNamespace) -> None:
    stage = trained(scene, lump, steps=2)
    alone = AppearancePass(scene, {}, stage.shading, 24, 2)
    kept = measure_preservation(stage.rendering, alone, ring_cameras(4, np.zeros(3)), 1.0, 48, 4)
    assert kept.base_psnr_db >= 60 and kept.mask_error == 0 and kept.untouched_share > 0.05


@pytest.mark.usefixtures("one_thread")
def test_resuming_goes_on_exactly(scene: EditScene, lump: SimpleNamespace, tmp_path: Path) -> None:
    def fresh(steps: int = 6) -> AppearanceStage:
        config = settings(steps=steps, style=True, style_samples=64)
        config = config.model_copy(update={"output": config.output.model_copy(update={"checkpoint_every": 3})})
        return AppearanceStage(scene, config, {"part": lump}, AskForColour(RED), lambda line: None)

    whole = fresh()
    run_stage(whole, tmp_path / "whole", quiet=True, say=lambda line: None)
    half = fresh()
    half.steps = 3
    run_stage(half, tmp_path / "half", quiet=True, say=lambda line: None)
    rest = fresh()
    run_stage(rest, tmp_path / "half", resume=True, quiet=True, say=lambda line: None)
    for name, value in whole.field.state_dict().items():
        assert torch.equal(value, rest.field.state_dict()[name]), name
    rows = read_metrics(tmp_path / "half" / "metrics.jsonl")
    assert [row["step"] for row in rows] == list(range(1, 7)) and rows[0]["stage"] == "appearance"


def test_views_that_do_not_fill_the_mosaic_are_refused(scene: EditScene, lump: SimpleNamespace) -> None:
    guidance = AskForColour(RED)
    guidance.view_grid = 2
    with pytest.raises(UserError, match="appearance.views = 2"):
        AppearanceStage(scene, settings(), {"part": lump}, guidance, lambda line: None)


def test_exposure_follows_the_light_and_not_the_base(make_scene: Callable[..., Path], lump: SimpleNamespace) -> None:
    """Under a uniform light of radiance L, clay (base colour 0.5 and its gloss) sends about 0.6 L."""
    found = []
    for level, grey in ((1.0, 0.5), (4.0, 0.5), (1.0, 0.05)):
        light = f'<emitter type="constant"><rgb name="radiance" value="{level}"/></emitter>'
        bsdf = f'<bsdf type="diffuse"><rgb name="reflectance" value="{grey}"/></bsdf>'
        edited = load_edit_scene(make_scene(light=light, base=BASE.replace('<bsdf type="diffuse"/>', bsdf)))
        found.append(AppearanceStage(edited, settings(exposure=None), {"part": lump}, None, lambda line: None).exposure)
    assert found[0] == pytest.approx(1.0, rel=0.1)
    assert found[1] == pytest.approx(found[0] / 4, rel=0.02) and found[2] == pytest.approx(found[0], rel=1e-3)
