"""Settings follow the guidance model where the user makes no choice, and are questioned where they do not fit it."""

from __future__ import annotations

from pathlib import Path

import pytest

from fd_mitsuba.config import RunConfig, misfits, settings_for_run
from fd_mitsuba.config.toml_reading import preset_names
from fd_mitsuba.errors import UserError

ROOT = Path(__file__).parents[2]


def test_the_built_in_prior_gets_the_quick_settings() -> None:
    chosen = settings_for_run(None, ["geometry.steps=7"])
    assert chosen.config == RunConfig.load(ROOT / "configs" / "quick.toml", ["geometry.steps=7"])
    assert chosen.remark is not None and "quick" in chosen.remark and "built-in" in chosen.remark


@pytest.mark.parametrize("model", ["someone/stable-diffusion", "weights/sd"])
def test_any_other_model_gets_the_papers(model: str) -> None:
    chosen = settings_for_run(None, [f"guidance.model={model}"])
    assert chosen.config == RunConfig.load(ROOT / "configs" / "paper.toml", [f"guidance.model={model}"])
    assert chosen.remark is not None and "paper" in chosen.remark and model in chosen.remark
    assert misfits(chosen.config) == []


@pytest.mark.parametrize(
    "said", ['{"whole_words": true}', '{"vocabulary": {"bodies": {}, "parts": {"wings": ["wings"]}}}']
)
def test_a_packed_prior_counts_as_the_built_in_one(tmp_path: Path, said: str) -> None:
    (tmp_path / "fd_mitsuba.json").write_text(said)
    chosen = settings_for_run(None, [f"guidance.model={tmp_path}"])
    assert chosen.config.geometry.steps == RunConfig.load("quick").geometry.steps
    assert misfits(chosen.config) == []


@pytest.mark.parametrize(
    "said", ['{"views_together": 8, "prompt_template": "{prompt}"}', "{}", '{"whole_words": false}', "[]", "{"]
)
def test_conventions_alone_do_not_make_a_model_small(tmp_path: Path, said: str) -> None:
    """What docs/real_weights.md has users of multi-view models write."""
    (tmp_path / "fd_mitsuba.json").write_text(said)
    chosen = settings_for_run(None, [f"guidance.model={tmp_path}"])
    assert chosen.config.geometry.steps == RunConfig.load("paper").geometry.steps
    assert misfits(chosen.config) == []


@pytest.mark.parametrize("name", ["quick", "paper", "smoke"])
def test_shipped_settings_go_by_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # outside the repository, as from a wheel
    assert RunConfig.load(name) == RunConfig.load(ROOT / "configs" / f"{name}.toml")
    assert settings_for_run(name).remark is None
    assert name in preset_names()


def test_a_file_of_that_name_goes_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("quick").write_text("seed = 9")
    assert RunConfig.load("quick").seed == 9


def test_an_unknown_name_lists_the_known() -> None:
    with pytest.raises(UserError, match="quik: no such config file; give one of paper, quick, smoke"):
        RunConfig.load("quik")


def test_a_dict_is_taken_and_left_as_it_is() -> None:
    given = {"geometry": {"steps": 5}}
    assert RunConfig.load(given, ["geometry.views=8"]).geometry.views == 8
    assert given == {"geometry": {"steps": 5}}


@pytest.mark.parametrize(
    "choice, overrides, named",
    [
        ("paper", ["guidance.model=builtin"], ("guidance.guidance_scale = 100 (quick: 5)", "-c quick")),
        ("quick", ["guidance.timestep_range_coarse=[0.02, 0.35]"], ("timestep_range_coarse = [0.02, 0.35]",)),
        ("quick", ["appearance.background=white"], ("appearance.background = white (quick: black)",)),
        ("quick", ["guidance.model=a/b"], ("fit a/b", "guidance.guidance_scale = 5 (paper: 100)", "-c paper")),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(choice: str, overrides: list[str], named: tuple[str, ...]) -> None:
    (line,) = misfits(RunConfig.load(choice, overrides))
    assert all(text in line for text in named) and "\n" not in line


@pytest.mark.parametrize(
    ("setting", "owner"),
    [
        ("lora_scale=0.5", "lora=a.safetensors"),
        ("image_prompt_scale=0.5", "image_prompt=a.png"),
        ("controlnet_scale=0", "controlnet=a/b"),
        ("controlnet_sees=normal", "controlnet=a/b"),
    ],
)
def test_a_setting_of_what_is_not_there_has_no_effect(setting: str, owner: str) -> None:
    (line,) = misfits(RunConfig.load("paper", [f"guidance.{setting}"]))
    key, _, value = setting.partition("=")
    name = owner.partition("=")[0]
    assert line == f"guidance.{key} = {value}: has no effect without guidance.{name}; give that, too"
    assert misfits(RunConfig.load("paper", [f"guidance.{setting}", f"guidance.{owner}"])) == []
    assert len(misfits(RunConfig.load("quick", [f"guidance.{setting}", "guidance.model=a/b"]))) == 2
    usual = getattr(RunConfig().guidance, key)
    assert misfits(RunConfig.load("paper", [f"guidance.{key}={usual}"])) == []


@pytest.mark.parametrize("choice", ["quick", "paper", "smoke"])
def test_shipped_settings_fit_their_own_model(choice: str) -> None:
    assert misfits(RunConfig.load(choice)) == []


def test_a_variant_has_a_scale_of_its_own() -> None:
    assert misfits(RunConfig.load("paper", ["guidance.variant=csd", "guidance.guidance_scale=1"])) == []
