"""Prompts that only one of the shipped priors can draw get that one, and say so; all others are left alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import INTEGRATOR

from fd_mitsuba.config import RunConfig
from fd_mitsuba.evaluation.verdict import can_be_judged
from fd_mitsuba.guidance.model_for_prompt import model_for_prompt
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.runs.scene_model import model_for_run, model_for_scene
from fd_mitsuba.scene.load_scene import load_edit_scene

QUICK = RunConfig.load("quick")


@pytest.mark.parametrize(
    ("prompt", "line"),
    [
        ("a cat with a crown", None),
        ("put a tiara on the dragon", None),  # both know crowns, and dogs stand in for dragons
        ("a cat with a halo", "guidance.model: builtin-wide, which knows halo"),
        ("a bear with a muffler and a crown", "guidance.model: builtin-wide, which knows scarf"),
        ("a man with sunglasses", None),
        ("a rabbit in a top hat", "guidance.model: builtin-wide, which draws top hat better"),
        ("a rabbit with a top hat and a sword", "guidance.model: builtin-wide, which knows sword"),
        ("a cat with a laptop", None),  # neither knows it
        ("a mug without a handle", None),  # nothing is added; a run says so
    ],
)
def test_the_prior_that_knows_the_part(prompt: str, line: str | None) -> None:
    config, said = model_for_prompt(QUICK, [prompt])
    assert said == line and config.guidance.model == ("builtin-wide" if line else "builtin")
    assert config.geometry == QUICK.geometry


def test_a_part_of_its_own_counts_and_so_does_a_cut() -> None:
    _, said = model_for_prompt(QUICK, ["a cat with a crown", "a cat with an umbrella", "a cat with an umbrella"])
    assert said == "guidance.model: builtin-wide, which knows umbrella"
    _, said = model_for_prompt(QUICK, ["a mug without a handle"], subtracts=True)
    assert said == "guidance.model: builtin-wide, which takes parts off"


def test_a_model_that_was_named_stays() -> None:
    named = RunConfig.load("quick", ["guidance.model=owner/stable-diffusion"])
    assert model_for_prompt(named, ["a cat with a halo"]) == (named, None)


def test_a_run_that_has_begun_keeps_its_model(make_scene: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene(integrator=INTEGRATOR.replace("two wings", "a hat")))
    assert model_for_run(QUICK, scene, tmp_path)[0].guidance.model == "builtin-wide"
    (tmp_path / "config.json").write_text('{"guidance": {"model": "builtin"}}')
    assert model_for_run(QUICK, scene, tmp_path) == (QUICK, None)
    (tmp_path / "config.json").write_text('{"guidance": {"model": "builtin-wide"}}')
    assert model_for_run(QUICK, scene, tmp_path)[0].guidance.model == "builtin-wide"


def test_runs_and_checks_take_it(make_scene: Callable[..., Path]) -> None:
    scene = load_edit_scene(make_scene(integrator=INTEGRATOR.replace("two wings", "a mushroom cap")))
    config, said = model_for_scene(QUICK, scene)
    assert config.guidance.model == "builtin-wide" and said is not None
    report = check_scene(scene, QUICK)
    assert report.refusal is None and "model    builtin-wide, which knows mushroom cap" in report.lines()
    assert can_be_judged(scene, QUICK)
    unguided = RunConfig.load("quick", ["geometry.lambda_sds=0", "appearance.lambda_sds=0"])
    assert model_for_scene(unguided, scene) == (unguided, None)
