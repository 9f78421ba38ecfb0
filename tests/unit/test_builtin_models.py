"""The names of the shipped priors: what they stand for, and how their words differ."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import INTEGRATOR

from fd_mitsuba.config import settings_for_run
from fd_mitsuba.config.for_model import is_builtin, is_small_prior
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.builtin import (
    APPEARANCE_FOLDER,
    BUILTIN_FOLDER,
    WIDE_APPEARANCE_FOLDER,
    WIDE_FOLDER,
    shipped_folder,
)
from fd_mitsuba.guidance.loading import locate
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.understood_prompt import understood_prompt
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.runs.network_size import network_size
from fd_mitsuba.scene.load_scene import load_edit_scene

WIDE = "guidance.model=builtin-wide"


def test_names_stand_for_folders() -> None:
    assert [locate(name) for name in ("builtin", "builtin-wide")] == [BUILTIN_FOLDER, WIDE_FOLDER]
    of_colours = [locate(name, appearance=True) for name in ("builtin", "builtin-wide")]
    assert of_colours == [APPEARANCE_FOLDER, WIDE_APPEARANCE_FOLDER]
    assert shipped_folder("a/folder") is None and not is_builtin("a/folder") and is_small_prior("builtin-wide")


def test_the_wide_one_gets_the_quick_settings() -> None:
    chosen = settings_for_run(None, [WIDE])
    assert chosen.config.geometry.steps == settings_for_run("quick").config.geometry.steps
    assert chosen.remark == "settings: quick, which suit the wide built-in prior; -c chooses others"


def test_its_weights_are_counted_right() -> None:
    size = (WIDE_FOLDER / "unet" / "diffusion_pytorch_model.safetensors").stat().st_size
    assert network_size("builtin-wide").weights == pytest.approx(size / 2, rel=0.02)


def test_a_part_that_only_the_wide_one_knows() -> None:
    few, wide = vocabulary_of("builtin"), vocabulary_of("builtin-wide")
    assert few is not None and wide is not None
    with pytest.raises(UserError, match="the wide built-in one knows mushroom cap; set guidance.model=builtin-wide"):
        understood_prompt("a pig with a mushroom cap", few)
    assert understood_prompt("a pig with a mushroom cap", wide).parts == ("mushroom cap",)
    with pytest.raises(UserError, match="knows no such part; nearest: wings"):
        understood_prompt("a pig with a laptop", few)


@pytest.mark.parametrize("model", ["builtin", "builtin-wide"])
def test_colours_know_every_word_of_the_shapes_they_go_with(model: str) -> None:
    shapes, colours = vocabulary_of(model), vocabulary_of(model, appearance=True)
    assert shapes is not None and shapes == colours


def test_a_part_that_only_the_wide_one_knows_gets_its_material_too(make_scene: Callable[..., Path]) -> None:
    scene = load_edit_scene(make_scene(integrator=INTEGRATOR.replace("two wings", "a mushroom cap")))
    report = check_scene(scene, settings_for_run(None, [WIDE]).config)
    assert report.refusal is None and report.cost.appearance_seconds_total > 0
