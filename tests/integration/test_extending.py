"""The examples of docs/extending.md are a module outside of the package; an edit with all of them, both ways."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from normal_data import chunk, denoiser, how

import fd_mitsuba as fd
from fd_mitsuba.batch.local import job_matrix, run_batch
from fd_mitsuba.cli.main import main
from fd_mitsuba.config.registry import load_plugins
from fd_mitsuba.runs.choices import REGISTRIES
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.plugins import region_choice
from fd_mitsuba.scene.scene_file import file_threads

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
NAMES = {
    "guidances": "silhouette",
    "variants": "blend",
    "geometry_losses": "thin",
    "appearance_losses": "grey",
    "exporters": "stl",
    "region_shapes": "egg",
}
CHOSEN = [
    "guidance.kind=silhouette",
    "guidance.variant=blend",
    "geometry.losses.thin.lambda=0.1",
    "appearance.losses.grey.lambda=0.1",
]
TINY = ["geometry.steps=2", "appearance.steps=2", "output.turntable_frames=2", "output.texture_size=64"]
TINY += ["output.picture_size=0", "output.faces=1000"]


def examples() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the examples as `mine.py`, and the shipped cat with the page's region instead of its own."""
    folder = tmp_path_factory.mktemp("extending")
    (folder / "mine.py").write_text("\n\n".join(examples()))
    shutil.copytree(ROOT / "scenes" / "cat", folder / "cat")
    shutil.copytree(ROOT / "scenes" / "lighting", folder / "lighting")
    region = re.search(r"^```xml\n(.*?)^```$", PAGE, re.M | re.S).group(1)
    scene = (folder / "cat" / "scene.xml").read_text()
    own = re.search(r'<shape type="focal_region".*?</shape>', scene, re.S).group(0)
    transform = re.compile(r"<transform.*</transform>", re.S)
    placed = transform.sub(transform.search(own).group(0), region)
    (folder / "cat" / "scene.xml").write_text(scene.replace(own, placed))
    return folder


@contextmanager
def registered(place: Path) -> Iterator[None]:
    """The module is imported; then its entries go again, so that other tests see the package as it is."""
    before = [dict(registry._entries) for registry in REGISTRIES]
    load_plugins([str(place / "mine.py")])
    yield
    for registry, entries in zip(REGISTRIES, before, strict=True):
        registry._entries = entries
    for name in [name for name in sys.modules if name.startswith("fd_mitsuba_plugin_") and name.endswith("_mine")]:
        del sys.modules[name]


@pytest.fixture
def mine(place: Path) -> Iterator[None]:
    with registered(place):
        yield


@pytest.fixture(scope="module")
def edited(place: Path) -> tuple[fd.Run, EditScene]:
    with registered(place):
        scene = fd.load_scene(place / "cat" / "scene.xml")
        settings = fd.Config.load("smoke", [*TINY, *CHOSEN])
        return fd.edit(scene, settings, output=place / "python", quiet=True), scene


def command(*words: str) -> str:
    """What a command prints, in a process of its own."""
    program = [sys.executable, "-m", "fd_mitsuba", *words]
    result = subprocess.run(program, capture_output=True, text=True, timeout=280)
    assert result.returncode == 0, result.stderr
    return result.stdout


def rows(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def check_run(folder: Path) -> None:
    """What an edit with all six examples leaves."""
    shape = [row for row in rows(folder) if row["phase"] != "appearance"]
    colours = [row for row in rows(folder) if row["phase"] == "appearance"]
    assert len(shape) == len(colours) == 2
    assert all(row["loss_thin"] > 0 and 0 < row["covered"] < 1 for row in shape), "the guidance and the loss"
    assert all(row["loss_grey"] >= 0 and row["guidance_gradient_max"] > 0 for row in colours), "the loss, the variant"
    record = json.loads((folder / "config.json").read_text())
    assert record["guidance"]["kind"] == {"kind": "silhouette", "coverage": 0.2}
    assert record["guidance"]["variant"] == {"kind": "blend", "share": 0.5}
    assert record["geometry"]["losses"] == {"thin": {"lambda": 0.1, "depth": 0.05}}
    assert json.loads((folder / "metrics.json").read_text())["guidance_model"] == "silhouette"


def test_there_is_one_example_of_each_kind_in_about_twenty_lines(mine: None) -> None:
    assert {registry.kind: NAMES[registry.kind] in registry.names() for registry in REGISTRIES} == dict.fromkeys(
        NAMES, True
    )
    assert len(examples()) == len(NAMES)
    assert all(len([line for line in text.splitlines() if line.strip()]) <= 22 for text in examples())
    for registry in REGISTRIES:
        assert f"fd.{registry.kind.upper()}" in PAGE and f"`{registry.kind}`" in PAGE


def test_an_edit_from_python(edited: tuple[fd.Run, EditScene], mine: None) -> None:
    run, scene = edited
    egg = scene.regions[0].mesh
    assert egg is not None
    upper, lower = egg.vertices[:, 1].max(), egg.vertices[:, 1].min()
    middle = scene.frame.to_canonical(np.array([[-12, 34.2, 55.5]]))[0][1]
    assert (upper - middle) / (middle - lower) == pytest.approx(1.8), "the region's shape, with its property"
    check_run(run.folder)
    (path,) = run.export(["stl"], texture_size=16)
    assert path == run.folder / "export" / "stl" / "part_part.stl"
    volume = trimesh.load_mesh(path).volume
    run.export([fd.Choice.of("stl", {"scale": 10})], texture_size=16)
    assert trimesh.load_mesh(path).volume == pytest.approx(1000 * volume, rel=1e-4)
    assert volume == pytest.approx(run.part().volume, rel=1e-4)


@pytest.mark.slow
def test_an_edit_from_the_command_line(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own, which finds the module by --plugin alone."""
    monkeypatch.chdir(place)
    words = ["run", "cat/scene.xml", "-c", "smoke", "--plugin", "mine.py", "-q", "-o", "words"]
    spoken = command(*words, *[word for item in [*TINY, *CHOSEN] for word in ("--set", item)])
    assert "words: part in export/" in spoken
    check_run(place / "words")
    assert json.loads((place / "words" / "config.json").read_text())["plugins"] == ["mine.py"]
    written = command(
        "export", "words", "--plugin", "mine.py", "--format", "glb", "stl {scale = 2}", "--texture-size", "16"
    ).split()
    assert {Path(name).name for name in written} == {"asset.glb", "part_part.stl"}
    assert "thin: Mean of max(sdf_part - depth, 0)" in command("names", "--plugin", "mine.py")


def test_a_region_like_that_in_a_plain_render(mine: None, place: Path) -> None:
    """Mitsuba itself reads the scene: our plugin takes the shape's properties, so that none is unknown to it."""
    mi = fd.register()
    with file_threads():
        shapes = {shape.id(): shape for shape in mi.load_file(str(place / "cat" / "scene.xml")).shapes()}
    assert shapes["hat"].face_count() == 20 * 4**4
    assert region_choice({"shape": "egg", "point": 1.8, "part": "x"}) == fd.Choice.of("egg", {"point": 1.8})


def test_a_blend_without_a_share_is_score_distillation(mine: None) -> None:
    what = chunk(100, 700)
    got = denoiser().latent_gradient(what, how("blend", {"share": 0.0}, guidance_scale=7.5))[0]
    torch.testing.assert_close(got, denoiser().latent_gradient(what, how("sds", guidance_scale=7.5))[0])


def test_without_the_module_the_names_are_unknown_and_nothing_is_written(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, output = ROOT / "scenes" / "cat" / "scene.xml", place / "none"
    keys = ("guidance.kind", "guidance.variant", "geometry.losses.thin", "appearance.losses.grey")
    for override, key in zip(CHOSEN, keys, strict=True):
        assert main(["run", str(scene), "-o", str(output), "-c", "smoke", "--set", override]) == 1
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert error.startswith(f"fd_mitsuba: error: {key}: unknown") and "--plugin" in error
    assert main(["check", str(scene), "--set", CHOSEN[0]]) == 1
    assert "guidance.kind: unknown guidance 'silhouette'; known: diffusion" in capsys.readouterr().err
    assert main(["check", str(place / "cat" / "scene.xml")]) == 1
    assert "unknown region shape 'egg'; known: ellipsoid, box, cylinder" in capsys.readouterr().err
    assert not output.exists()


def test_a_batch_checks_names_before_it_starts_anything(place: Path, tmp_path: Path) -> None:
    scene = place / "cat" / "scene.xml"
    jobs = job_matrix([scene], [Path("smoke")], [0, 1], [*TINY, CHOSEN[2]], tmp_path / "batch")
    with pytest.raises(fd.UserError, match="^geometry.losses.thin: unknown geometry loss 'thin'"):
        run_batch(jobs, record=tmp_path / "batch.json")
    assert list(tmp_path.iterdir()) == []


def test_a_run_folder_imports_nothing(edited: tuple[fd.Run, EditScene], tmp_path: Path) -> None:
    """Its settings name a module that would leave a trace: an export does not import it, and says what it lacks."""
    folder = shutil.copytree(edited[0].folder, tmp_path / "run")
    (tmp_path / "trace.py").write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'trace')!r}).touch()")
    record = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(record | {"plugins": [str(tmp_path / "trace.py")]}))
    with pytest.raises(fd.UserError, match="unknown region shape 'egg'; .*--plugin MODULE"):
        fd.Run.open(folder).export(["ply"], texture_size=16)
    with registered(edited[0].folder.parent):
        fd.Run.open(folder).export(["ply"], texture_size=16)
    assert not (tmp_path / "trace").exists()
    load_plugins([str(tmp_path / "trace.py")])
    assert (tmp_path / "trace").exists()
