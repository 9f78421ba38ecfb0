"""Both stages through the command line: outputs, resuming, another material for a finished shape, relighting."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from PIL import Image
from tiny_pipelines import save_pipeline
from tiny_runs import BOTH_STAGES_OUTPUT, FIELD, TEXTURE, write_place

from fd_mitsuba.cli.main import main
from fd_mitsuba.training.checkpoint import list_checkpoints
from fd_mitsuba.training.record import read_metrics

SETTINGS = (
    FIELD
    + """
[geometry]
steps = 2
grid_resolution = 16
focal_samples = 256
views = 2
spp = 1
"""
    + TEXTURE
    + """
[appearance]
steps = 3
views = 2
spp = 2
picture_size = 16
style = true
style_samples = 32
boundary_reach = 0.1
"""
    + BOTH_STAGES_OUTPUT
)
LIGHT = """<default name="level" value="1.0"/>
  <emitter type="constant" id="light"><rgb name="radiance" value="$level"/></emitter>"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    root = write_place(tmp_path_factory.mktemp("whole"), animal, SETTINGS, light=LIGHT)
    save_pipeline("sd15", root / "sd15")
    return root


def run(place: Path, output: str, *more: str, picture_size: int = 0) -> int:
    words = ["run", place / "scene.xml", "-c", place / "tiny.toml", "--set", f"guidance.model={place / 'sd15'}"]
    words += ["--set", f"output.picture_size={picture_size}"]
    return main([str(word) for word in (*words, "-o", place / output, "-q", "-t", "2", *more)])


@pytest.fixture(scope="module")
def finished(place: Path) -> Path:
    assert run(place, "run", picture_size=32) == 0
    return place / "run"


def test_pictures_and_assets_are_there(finished: Path) -> None:
    frames = imageio.imread(finished / "videos" / "appearance.mp4")
    assert frames.shape[1:] == (32, 32, 3)
    for name, size in (("appearance", (48, 48)), ("channels", (256, 400)), ("beauty", (32, 32)), ("closeup", (32, 32))):
        with Image.open(finished / "images" / f"{name}.png") as image:
            assert image.size == size and np.asarray(image).std() > 10
    names = {path.name for path in (finished / "export").rglob("*") if path.is_file()}
    assert {"asset.glb", "scene.xml", "part_part.ply", "part_part_base_color.png", "animal.ply"} <= names


def test_metrics_of_both_stages(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["base_identical"] is True and metrics["appearance"]["base_psnr_db"] >= 60
    assert metrics["appearance"]["mask_error"] == 0
    rows = read_metrics(finished / "metrics.jsonl")
    assert [row["step"] for row in rows if row["stage"] == "appearance"] == [1, 2, 3]
    assert {"loss_sds", "loss_style_gradient", "loss_style_boundary"} <= set(rows[-1])


def test_a_finished_shape_takes_another_material(place: Path, finished: Path) -> None:
    assert run(place, "again", "--from", str(finished), "--prompt", "a pig with golden wings") == 0
    again = place / "again"
    same = "export/part_part.ply"
    assert (again / same).read_bytes() == (finished / same).read_bytes()
    assert json.loads((again / "metrics.json").read_text())["prompt"] == "a pig with golden wings"
    stages = {row["stage"] for row in read_metrics(again / "metrics.jsonl")}
    assert stages == {"appearance"}


def test_a_run_goes_on_where_its_scene_is_gone(place: Path, finished: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """By the same rule as other commands: the copy is read, and that is said. Another path is no excuse."""
    copy = shutil.copytree(finished, place / "without_scene")
    hidden = place / "hidden.xml"
    (place / "scene.xml").rename(hidden)
    capfd.readouterr()
    try:
        assert run(place, "without_scene", "--resume") == 0
        assert f"gone; taking the copy of it in {copy / 'scene'}" in capfd.readouterr().err
        assert main(["run", str(place / "typo.xml"), "-o", str(copy), "--resume"]) == 1
        assert "typo.xml: no such scene file" in capfd.readouterr().err
        assert run(place, "nothing_there", "--resume") == 1
        assert "scene.xml: no such scene file" in capfd.readouterr().err
    finally:
        hidden.rename(place / "scene.xml")
    same = "export/part_part.ply"
    assert (copy / same).read_bytes() == (finished / same).read_bytes()


def test_a_finished_shape_is_not_taken_for_other_regions(
    place: Path, finished: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    moved = (place / "scene.xml").read_text().replace('y="0.35"', 'y="0.36"')
    (place / "moved.xml").write_text(moved)
    words = ["run", str(place / "moved.xml"), "-c", str(place / "tiny.toml"), "-o", str(place / "moved"), "-q"]
    assert main([*words, "--set", f"guidance.model={place / 'sd15'}", "--from", str(finished)]) == 1
    error = capfd.readouterr().err
    assert "focal regions are others" in error and "Traceback" not in error
    assert not (place / "moved").exists()


def test_a_material_prompt_without_a_known_part_is_refused(
    place: Path, finished: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--from", str(finished), "--prompt", "a pig with a spoon", "--set", "guidance.model=builtin"]
    assert run(place, "spoon", *words, "--set", "appearance.views=4") == 1
    error = capfd.readouterr().err
    assert "knows no such part" in error and "Traceback" not in error


def test_shape_first_and_material_later(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(place, "parts", "--stage", "geometry") == 0
    assert not (place / "parts" / "images" / "appearance.png").exists()
    assert main(["render", str(place / "parts")]) == 1
    assert "appearance stage has not begun" in capfd.readouterr().err
    # The material's own settings may be other ones now; they are those of the run from then on.
    assert run(place, "parts", "--stage", "appearance", "--set", "appearance.steps=4") == 0
    assert len(list_checkpoints(place / "parts" / "checkpoints_appearance")) == 2
    assert json.loads((place / "parts" / "config.json").read_text())["appearance"]["steps"] == 4
    assert main(["export", str(place / "parts"), "--format", "ply", "--texture-size", "16"]) == 0
    capfd.readouterr()
    before = (place / "parts" / "config.json").read_bytes()
    assert run(place, "parts", "--resume", "--set", "appearance.steps=5") == 1
    assert "appearance.steps = 4, now 5" in capfd.readouterr().err
    assert (place / "parts" / "config.json").read_bytes() == before  # nothing is written before it is refused


def test_a_resume_takes_settings_that_change_no_result(
    place: Path, finished: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(finished, place / "other_output")
    settings = ("output.turntable_frames=3", "output.texture_size=64", "guidance.views_per_call=1")
    capfd.readouterr()
    words = [word for item in settings for word in ("--set", item)]
    assert run(place, "other_output", "--resume", *words, picture_size=16) == 0
    error = capfd.readouterr().err
    assert "guidance.views_per_call = 1 (was 4)" in error and "output.turntable_frames = 3 (was 2)" in error
    assert len(imageio.imread(copy / "videos" / "appearance.mp4")) == 3
    with Image.open(copy / "export" / "textures" / "part_part_base_color.png") as picture:
        assert picture.size == (64, 64)
    name = "checkpoints_appearance/step_000003.safetensors"
    assert (copy / name).read_bytes() == (finished / name).read_bytes()
    # And on from there with the settings as they are now.
    words = [word for item in settings for word in ("--set", item)]
    assert run(place, "other_output", "--resume", *words, picture_size=16) == 0
    assert "goes on with" not in capfd.readouterr().err


def test_another_light(place: Path, finished: Path) -> None:
    pictures = {}
    for level in ("1.0", "0.1"):
        words = ["render", str(finished), "-D", f"level={level}", "--views", "1", "--size", "24", "--spp", "8"]
        assert main([*words, "-o", f"at_{level}"]) == 0
        with Image.open(finished / "renders" / f"at_{level}_00.png") as picture:
            pictures[level] = np.asarray(picture).astype(float)
    # The exposure follows the light, so a uniform light of another level gives the same picture.
    assert np.abs(pictures["1.0"] - pictures["0.1"]).mean() < 1.5


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--stage", "appearance"), "no checkpoint; run the geometry stage first"),
        (("--from", "nowhere"), "no such run folder"),
    ],
)
def test_without_a_finished_shape(
    place: Path, words: tuple[str, ...], expected: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(place, "nothing", *words) == 1
    error = capfd.readouterr().err
    assert expected in error and "Traceback" not in error
    assert not (place / "nothing").exists()


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["csd", "ism", "reconstruction", "vsd"])
def test_every_variant_runs_both_stages(place: Path, variant: str) -> None:
    more = ["--set", f"guidance.variant={variant}", "--set", "geometry.steps=3", "--set", "guidance.guidance_scale=7.5"]
    assert run(place, variant, *more) == 0
    rows = read_metrics(place / variant / "metrics.jsonl")
    assert {row["stage"] for row in rows} == {"geometry", "appearance"}
    assert len(rows) == 6 and all(np.isfinite(row["loss_sds"]) and row["loss_sds"] > 0 for row in rows)
