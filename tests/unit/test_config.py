"""Settings: what is accepted, what is refused in one line, and what changes the hash."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from pydantic import ValidationError

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.identity import changeable_settings, flat_settings
from fd_mitsuba.config.sections import OutputConfig
from fd_mitsuba.errors import UserError

ROOT = Path(__file__).resolve().parents[2]


def refusal(path: Path | None = None, *overrides: str) -> str:
    with pytest.raises(UserError) as caught:
        RunConfig.load(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_defaults_are_the_papers() -> None:
    config = RunConfig.load(None)
    assert config == RunConfig()
    geometry = config.geometry
    assert (geometry.steps, geometry.learning_rate, geometry.union_k, geometry.views) == (3000, 1e-3, 0.15, 4)
    assert config.guidance.guidance_scale == 100.0
    appearance = config.appearance
    assert (appearance.steps, appearance.learning_rate, appearance.timestep_range) == (2000, 1e-2, (0.02, 0.98))
    assert (appearance.lambda_style, appearance.lambda_boundary, config.texture.hidden) == (10, 100, 32)


@pytest.mark.parametrize("name", ["paper", "quick", "smoke"])
def test_shipped_files_are_valid(name: str) -> None:
    RunConfig.load(ROOT / "configs" / f"{name}.toml")


def test_file_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("seed = 3\n[geometry]\nsteps = 7\nviews = 2\n")
    config = RunConfig.load(path, ["geometry.steps=9", "cameras.fov_deg=[40, 41]", "guidance.model=a/b", "seed=5"])
    assert (config.geometry.steps, config.geometry.views, config.seed) == (9, 2, 5)
    assert config.cameras.fov_deg == (40.0, 41.0) and config.guidance.model == "a/b"


@pytest.mark.parametrize(
    ("text", "value"),
    [("sd 2=1/x", "sd 2=1/x"), ('"1"', "1"), ("true story", "true story"), ("", "")],
)
def test_text_that_is_not_toml_stays_text(text: str, value: str) -> None:
    assert RunConfig.load(None, [f"guidance.model={text}"]).guidance.model == value


def test_missing_file() -> None:
    assert "nowhere.toml: no such config file" in refusal(Path("nowhere.toml"))


@pytest.mark.parametrize("content", [b"steps = ", b"[geometry\nsteps = 3", b"a = 1\na = 2\n", b"\xff\xfe\x00bad"])
def test_broken_file(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    assert str(path) in refusal(path)


def test_folder_instead_of_a_file(tmp_path: Path) -> None:
    assert "is a folder" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("override", "nearest"),
    [("geometry.step=3", "geometry.steps"), ("geometri.steps=3", "geometry"), ("sed=3", "seed")],
)
def test_unknown_key_names_the_nearest(override: str, nearest: str) -> None:
    message = refusal(None, override)
    assert "unknown key" in message and nearest in message


def test_unknown_key_in_a_file_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[output]\nshet_every = 3\n")
    message = refusal(path)
    assert str(path) in message and "output.sheet_every" in message


@pytest.mark.parametrize(
    "override",
    [
        "geometry.steps=many",
        "geometry.betas=[0.9, 2]",
        "guidance.timestep_range_coarse=[0.5, 0.2]",
        "geometry.step=3",
        "geometri.steps=3",
        "geometry.steps = 2.5",
    ],
)
def test_bad_override_is_blamed_itself_and_not_the_file(tmp_path: Path, override: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[geometry]\nsteps = 7\n")
    message = refusal(path, "seed=1", override, "geometry.views=2")
    assert message.startswith(f"--set {override}: ") and str(path) not in message


def test_bad_value_of_the_file_is_not_blamed_on_an_override(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[geometry]\nsteps = 0\n")
    assert refusal(path, "geometry.views=2").startswith(f"{path}: geometry.steps")
    path.write_text("[guidance]\ntimestep_range_coarse = [0.5, 0.2]\n")
    assert refusal(path, "geometry.views=2").startswith(f"{path}: ")


@pytest.mark.parametrize("override", ["geometry.steps = 200", " geometry . steps=200 ", "geometry.steps= 200"])
def test_blanks_in_an_override(override: str) -> None:
    assert RunConfig.load(None, [override]).geometry.steps == 200


def test_unknown_section_names_sections() -> None:
    message = refusal(None, "geometri.steps=3")
    assert "nearest: geometry" in message and "geometry.views" not in message


def test_values_that_do_not_fit_together_are_told_in_our_own_words() -> None:
    message = refusal(None, "cameras.fov_deg=[50, 40]")
    assert message.endswith("cameras.fov_deg = (50.0, 40.0) must be ordered and lie in [1, 150]; change the value")


@pytest.mark.parametrize("override", [" = 3", "geometry.steps", "=3", "geometry.steps.more.x", ""])
def test_override_that_is_none(override: str) -> None:
    assert "section.key=value" in refusal(None, override)


def test_override_below_a_value() -> None:
    assert "is a value, not a section" in refusal(None, "seed=1", "seed.x=2")


@pytest.mark.parametrize(
    "override",
    [
        "geometry.lambda_focal=-1",
        "geometry.lambda_sds=nan",
        "geometry.learning_rate=inf",
        "geometry.learning_rate=0",
        "geometry.learning_rate=fast",
        "geometry.steps=0",
        "geometry.steps=2.5",
        "geometry.grid_resolution=4",
        "geometry.grid_resolution=1000",
        "geometry.coarse_fraction=1.5",
        "geometry.betas=[0.9, 1.0]",
        "geometry.normal_space=object",
        "geometry=3",
        "guidance.timestep_range_coarse=[0.5, 0.2]",
        "guidance.timestep_range_refined=[0.5, 1.2]",
        "guidance.timestep_range_refined=[0.5]",
        "guidance.timestep_range_coarse=[nan, 0.5]",
        "guidance.dtype=float8",
        "cameras.fov_deg=[0, 40]",
        "cameras.elevation_deg=[-100, 0]",
        "output.checkpoint_every=0",
        "output.checkpoints_kept=0",
        "seed=-1",
        "seed=1e10",
    ],
)
def test_values_out_of_range(override: str) -> None:
    message = refusal(None, override)
    assert override.partition("=")[0].split(".")[0] in message


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValidationError):
        RunConfig().geometry.steps = 3  # type: ignore[misc]


LATER = ["variant=ism", 'variant={kind="ism", interval=0.1}', "kind=mine", "timestep_annealing=sqrt"]


def test_later_settings_count_only_when_they_are_changed() -> None:
    """So that runs from before can still be read; the device never counts."""
    hashes = [RunConfig.load(None, [f"guidance.{override}"]).content_hash() for override in LATER]
    assert len({RunConfig().content_hash(), *hashes}) == len(LATER) + 1
    assert RunConfig.load(None, ["guidance.device=cuda:1"]).content_hash() == RunConfig().content_hash()


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("variant=3", "guidance.variant"),
        ("variant.interval=0.1", "no name to go with; add the key kind"),
        ("model.interval=0.1", "guidance.model: Input should be a valid string"),
        ("timestep_annealing=cosine", "'none', 'linear' or 'sqrt'"),
        ("device=gpu", "device"),
    ],
)
def test_bad_guidance_is_one_line(override: str, expected: str) -> None:
    message = refusal(None, f"guidance.{override}")
    assert expected in message and f"--set guidance.{override}" in message


@pytest.mark.parametrize("key", ["lora", "words"])
def test_one_file_needs_no_brackets(key: str, tmp_path: Path) -> None:
    alone, listed = (
        RunConfig.load(None, [f"guidance.{key}={value}"]) for value in ("a.safetensors", '["a.safetensors"]')
    )
    assert getattr(alone.guidance, key) == ("a.safetensors",) and alone.content_hash() == listed.content_hash()
    (tmp_path / "a.toml").write_text(f'guidance.{key} = "a.safetensors"')
    assert RunConfig.load(tmp_path / "a.toml").guidance == alone.guidance
    assert f"guidance.{key}" in refusal(None, f"guidance.{key}=3")


def test_hash_follows_every_setting() -> None:
    overrides = ["seed=1", "geometry.steps=7", "guidance.model=x", "guidance.dtype=bfloat16", "cameras.aim=object"]
    hashes = [RunConfig.load(None, [override]).content_hash() for override in overrides]
    assert len({RunConfig().content_hash(), *hashes}) == len(overrides) + 1
    assert RunConfig.load(None, ["geometry.steps=3000"]).content_hash() == RunConfig().content_hash()
    assert RunConfig.model_validate(RunConfig().model_dump(mode="json")).content_hash() == RunConfig().content_hash()


def test_runs_from_before_a_setting_was_there_can_be_read() -> None:
    """Their settings lack it, and so does what was hashed: the same hash now, another one where it does something."""
    before = RunConfig().model_dump(mode="json")
    del before["geometry"]["lambda_tether"], before["geometry"]["start_variety"]
    read = RunConfig.model_validate(before)
    assert read.geometry.lambda_tether == 0 and "geometry.lambda_tether" not in read.identity()
    assert RunConfig.load(None, ["geometry.lambda_tether=1"]).content_hash() != read.content_hash()


def test_settings_that_may_change_on_the_way_are_marked_at_the_field() -> None:
    marked = changeable_settings(RunConfig)
    assert marked == {f"output.{name}" for name in OutputConfig.model_fields} | {
        "guidance.views_per_call",
        "guidance.device",
        "plugins",
    }
    switches = {"output.roughness_floor"}
    others = [
        "output.roughness_floor=false",
        "guidance.device=cuda:1",
        "guidance.views_per_call=1",
        *(f"{key}=170" for key in marked - switches if "out" in key),
    ]
    for stage in ("geometry", "appearance"):
        assert RunConfig.load(None, others).content_hash(stage) == RunConfig().content_hash(stage)
    # Everything else counts, each setting by itself.
    newer = {f"geometry.{name}" for name in ("lambda_tether", "start_variety", "lambda_curvature", "fade")}
    newer |= {"geometry.draft_fraction", "guidance.timestep_range_drafted"}
    newer |= {f"guidance.{name}" for name in ("perp_neg", "mask_margin", "lora", "lora_scale", "words")}
    newer |= {f"guidance.{name}" for name in ("mask_channel", "normal_augmentation", "refined_background", "reduction")}
    newer |= {f"guidance.{name}" for name in ("image_prompt", "image_prompt_scale", "ip_adapter", "ip_adapter_encoder")}
    newer |= {"appearance.soft_mask", "appearance.fade"} | {
        f"guidance.{name}" for name in ("controlnet", "controlnet_scale", "controlnet_sees")
    }
    counted = set(RunConfig().identity("appearance")) | marked | newer
    assert counted == set(flat_settings(RunConfig().model_dump()))


def test_every_number_has_an_upper_bound() -> None:
    """1e300 of a setting is refused, and the message says what is possible."""
    for key, value in flat_settings(RunConfig().model_dump()).items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        message = refusal(None, f"{key}=1e300")
        assert key in message and "less than" in message, message
    assert "appearance.exposure: Input should be less than" in refusal(None, "appearance.exposure=1e300")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("seed=" + "9" * 5000, "less than or equal to 2147483647"),
        ("seed=" + "[" * 5000, "valid integer"),
        ("seed" + ".a" * 5000 + "=1", "valid integer"),
        ("a" * 5000 + "=1", "unknown key"),
        ("appearance.spp=1000000000", "less than or equal to 4096"),
        ("appearance={spp=4096, views=64, picture_size=4096}", "at most 4294967295"),
        ("geometry={views=64, silhouette_spp=4096}", "at most 4294967295"),
        ("output={turntable_size=4096, turntable_frames=1000}", "at most 1000000000"),
        ('guidance.model="a\\u0000b"', "guidance.model"),
        ("geometry.focal_sigma_sdf=1e-300", "greater than or equal to"),
        ("cameras.radius=1e-300", "greater than or equal to 0.5"),
    ],
)
def test_extreme_values_are_refused_in_a_short_line(override: str, words: str) -> None:
    message = refusal(None, override)
    assert words in message and len(message) < 400


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seed = " + "9" * 5000, "line 1: a number of 5000 digits"),
        ("seed = " + "[" * 5000 + "]" * 5000, "nested too deep"),
        ("# " + "x" * (1 << 20), "more than 1.0 MB"),
    ],
)
def test_a_file_that_the_parser_cannot_take(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    message = refusal(path)
    assert message.startswith(str(path)) and words in message


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    assert "named pipe" in refusal(tmp_path / "pipe.toml")


@pytest.mark.parametrize(
    ("overrides", "plain"),
    [
        (["guidance.variant=csd"], "csd"),
        (["guidance.variant={kind = 'csd'}"], "csd"),
        (["guidance.variant=ism", "guidance.variant.interval=0.1"], {"kind": "ism", "interval": 0.1}),
        (["guidance.variant={kind='ism', interval=0.1}", "guidance.variant=csd"], "csd"),
        (
            ["guidance.variant={kind='ism', interval=0.1}", "guidance.variant.kind=csd"],
            {"kind": "csd", "interval": 0.1},
        ),
    ],
)
def test_a_choice_is_a_name_or_a_name_with_options(overrides: list[str], plain: object) -> None:
    config = RunConfig.load(None, overrides)
    assert config.model_dump(mode="json")["guidance"]["variant"] == plain
    assert RunConfig.model_validate(config.model_dump(mode="json")) == config


def test_losses_of_other_modules_have_a_weight_and_options() -> None:
    config = RunConfig.load(None, ["geometry.losses.thin.lambda=0.5", "geometry.losses.thin.depth=2"])
    assert config.model_dump(mode="json")["geometry"]["losses"] == {"thin": {"lambda": 0.5, "depth": 2}}
    assert RunConfig.model_validate(config.model_dump(mode="json")) == config
    assert config.content_hash() != RunConfig().content_hash()
    assert "geometry.losses.thin.lambda: Field required" in refusal(None, "geometry.losses.thin.depth=2")
    assert "geometry.losses.thin.lambda" in refusal(None, "geometry.losses.thin.lambda=-1")
    assert "geometry.losses.thin" in refusal(None, "geometry.losses.thin=1")


def test_settings_that_were_left_to_defaults_are_completed_by_a_record() -> None:
    """So that a finished run, whose record has all options, is known by the settings that asked for it."""
    asked = ["guidance.variant={kind='ism', interval=1}", "geometry.losses.thin.lambda=1"]
    record = ["guidance.variant={kind='ism', interval=1.0, inversion_step=0.2}"]
    record += ["geometry.losses.thin={lambda=1, depth=2}", "seed=5"]
    before = RunConfig.load(None, record)
    completed = RunConfig.load(None, asked).completed_by(before)
    assert completed.guidance == before.guidance and completed.geometry == before.geometry and completed.seed == 0
    other = RunConfig.load(None, ["guidance.variant={kind='ism', interval=0.5}", "geometry.losses.thin.lambda=2"])
    assert other.completed_by(before).guidance == other.guidance
    assert other.completed_by(before).geometry.losses["thin"].weight == 2


def test_the_modules_to_import_do_not_change_the_result() -> None:
    assert RunConfig.load(None, ["plugins=['a']"]).content_hash() == RunConfig().content_hash()
