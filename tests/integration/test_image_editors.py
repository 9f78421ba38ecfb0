"""Editors of single images: they change the views that they are given, and not what they are told to keep."""

from __future__ import annotations

from pathlib import Path

import diffusers
import numpy as np
import pytest
from tiny_pipelines import UNET_1_5, save_pipeline
from tiny_runs import write_place

from fd_mitsuba.baselines.editors_2d import instruction_for
from fd_mitsuba.baselines.interface import EditTask
from fd_mitsuba.baselines.methods import BASELINES
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.geometry_stage import GeometryStage

VIEWS = CameraBatch.around(np.array([30.0, 210.0]), 20.0, 3.4, 45.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray], mi: object) -> EditScene:
    return load_edit_scene(write_place(tmp_path_factory.mktemp("edited"), animal, "") / "scene.xml")


def task(scene: EditScene, folder: Path, *overrides: str) -> EditTask:
    return EditTask(scene, RunConfig.load("quick", overrides), folder, lambda line: None)


def test_an_edit_as_an_instruction() -> None:
    assert instruction_for("a horse with two wings", "a horse") == "put two wings on a horse"
    assert instruction_for("a rabbit with a hat", "") == "put a hat on a rabbit"
    assert instruction_for("a golden cat", "a cat") == "turn it into a golden cat"


def test_the_other_methods_are_guided_at_every_step(scene: EditScene, tmp_path: Path) -> None:
    given = task(scene, tmp_path)
    assert GeometryStage(scene, given.config, given.guidance).drafts is not None  # type: ignore[arg-type]
    assert given.own.drafts is None


def test_the_built_in_prior_edits_views_and_inpaints_regions(scene: EditScene, tmp_path: Path) -> None:
    given = task(scene, tmp_path)
    whole = BASELINES.make(Choice.of("pix2pix_2d", {"steps": 2}), "here", given)
    base, edited = whole.base_images(VIEWS, 64), whole.images(VIEWS, 64)
    assert given.guidance_calls == 2 * 2 and whole.mesh is None
    assert edited.kind == "normals" and edited.values.abs().max() <= 1
    change = (edited.rgb - base.rgb).abs().amax(dim=1, keepdim=True)
    assert (change > 0.1).float().mean() > 0.005
    filled = BASELINES.make(Choice.of("inpaint_2d", {"steps": 2}), "here", given)
    inside = filled.region_mask(VIEWS, 64, 1) > 0
    change = (filled.images(VIEWS, 64).rgb - base.rgb).abs().amax(dim=1, keepdim=True)
    assert change[~inside].max() < 1e-4 and change[inside].max() > 0.05
    assert given.guidance_calls == 4 * 2


@pytest.mark.slow
def test_pipelines_of_diffusers_edit_lit_views(scene: EditScene, tmp_path: Path) -> None:
    given = task(scene, tmp_path)
    folder = save_pipeline("ip2p", tmp_path / "ip2p")
    settings = {"model": str(folder), "steps": 3}
    edited = BASELINES.make(Choice.of("pix2pix_2d", settings), "here", given)
    base, made = edited.base_images(VIEWS, 32), edited.images(VIEWS, 32)
    assert base.kind == made.kind == "colour" and edited.side == 128
    assert given.guidance_calls == 2 * 3 and (made.rgb - base.rgb).abs().max() > 0.2
    plain = base.values[0, :, 0, 0].view(3, 1, 1)
    assert base.mask.max() > 0.99 and (base.values - plain).abs()[base.mask.expand(-1, 3, -1, -1) > 0.9].mean() > 0.03

    model = save_pipeline("sd15", tmp_path / "sd15")
    shown = {name: UNET_1_5[name] for name in ("block_out_channels", "down_block_types", "layers_per_block")}
    control = diffusers.ControlNetModel(
        **shown, cross_attention_dim=48, attention_head_dim=8, conditioning_embedding_out_channels=(8, 8, 16, 16)
    )
    control.save_pretrained(tmp_path / "control")
    settings = {"model": str(model), "controlnet": str(tmp_path / "control"), "steps": 3}
    filled = BASELINES.make(Choice.of("inpaint_2d", settings), "here", given)
    assert (filled.images(VIEWS, 32).rgb - base.rgb).abs().max() > 0.2

    inpainting = save_pipeline("inpaint", tmp_path / "inpaint")
    made = BASELINES.make(Choice.of("inpaint_2d", {"model": str(inpainting), "steps": 3}), "here", given)
    assert made.images(VIEWS, 32).mask.shape == (2, 1, 32, 32)

    for name, wrong, words in (
        ("pix2pix_2d", {"model": str(model)}, "has 4 input channels"),
        ("inpaint_2d", {"model": str(model)}, "has 4 input channels"),
        ("pix2pix_2d", {"model": str(tmp_path / "nothing")}, "nothing"),
    ):
        with pytest.raises(UserError, match=words):
            BASELINES.make(Choice.of(name, wrong), "here", given)
    real = task(scene, tmp_path, f"guidance.model={model}")
    with pytest.raises(UserError, match="name an image editor"):
        BASELINES.make(Choice.of("pix2pix_2d"), "here", real)
