"""The systems to compare with: each does what it is known for, all are asked alike, and a comparison goes on."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_pipelines import save_pipeline
from tiny_runs import FIELD, write_place

from fd_mitsuba.baselines import jobs as jobs_module
from fd_mitsuba.baselines.compare import compare, compare_jobs
from fd_mitsuba.baselines.fantasia3d import Fantasia3dSettings, WholeObjectStage, fit_error
from fd_mitsuba.baselines.figures import SEEN_AT
from fd_mitsuba.baselines.interface import EditedMesh, EditTask, mesh_images
from fd_mitsuba.baselines.jobs import CompareJob
from fd_mitsuba.baselines.measuring import CompareProtocol
from fd_mitsuba.baselines.methods import BASELINES
from fd_mitsuba.baselines.processes import run_processes
from fd_mitsuba.baselines.table import compare_header, compare_rows
from fd_mitsuba.baselines.voxe import VoxeGlobalSettings
from fd_mitsuba.baselines.voxels.edit_stage import loss_correlation
from fd_mitsuba.baselines.voxels.fitting import base_shown, fitted_grid
from fd_mitsuba.cli.compare import process_of
from fd_mitsuba.cli.main import command_parser, main
from fd_mitsuba.cli.scene_options import chosen_settings
from fd_mitsuba.config import RunConfig, Section
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.registry import NoSettings
from fd_mitsuba.config.toml_reading import read_choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.interface import GuidanceResult, GuidanceViews
from fd_mitsuba.guidance.sources import GUIDANCES
from fd_mitsuba.runs.own_meshes import as_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.views import CameraBatch

SETTINGS = f"""
{FIELD}
[geometry]
steps = 4
coarse_fraction = 1.0
grid_resolution = 24
views = 2
spp = 1
learning_rate = 5e-3
focal_samples = 200
lambda_focal = 1e7
lambda_collision = 0.0
[output]
turntable_frames = 2
turntable_size = 32
picture_size = 0
sheet_every = 0
faces = 400
"""
VOXELS = {"resolution": 20, "samples": 24, "fit_steps": 60, "fit_views": 10, "fit_size": 32, "fit_rays": 512}
VIEWS = CameraBatch.around(np.arange(4) * 90.0, 20.0, 3.4, 45.0)


class More:
    """Asks for as much of the object in the images as possible, and notes from where it was asked."""

    needs_base, view_grid, normal_space = False, 1, None

    def __init__(self, settings: object = None, config: object = None) -> None:
        self.asked: list[tuple[float, ...]] = []

    def picture_size(self, phase: str) -> int:
        return 24

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        return []

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: str, seed: int) -> GuidanceResult:
        self.asked.append((*(float(angle) for angle in views.azimuth_deg), float(seed)))
        return GuidanceResult(-views.pictures[:, 3].sum())


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    return write_place(tmp_path_factory.mktemp("compared"), animal, SETTINGS)


@pytest.fixture(scope="module")
def scene(place: Path, mi: object) -> EditScene:
    return load_edit_scene(place / "scene.xml")


@pytest.fixture
def more(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Settings whose guidance is `More`, registered while the test runs."""
    monkeypatch.setattr(GUIDANCES, "_entries", dict(GUIDANCES._entries))
    GUIDANCES.register("more", NoSettings)(More)
    yield ["guidance.kind=more"]


def task(scene: EditScene, place: Path, folder: Path, *overrides: str) -> EditTask:
    config = RunConfig.load(place / "tiny.toml", overrides)
    return EditTask(scene, config, folder, lambda line: None, _given=More())


def test_every_method_says_what_it_is_and_checks_its_settings() -> None:
    assert {"focaldreamer", "fantasia3d", "voxe_global"} <= set(BASELINES.names())
    for name in BASELINES.names():
        entry = BASELINES.entry(name, "here")
        assert entry.make.__doc__ and issubclass(entry.settings, Section)
        with pytest.raises(UserError, match="unknown key 'no_such_key'"):
            BASELINES.settings(Choice.of(name, {"no_such_key": 1}), "here")


def test_fantasia3d_starts_as_the_base_within_a_cell_and_then_moves_all_of_it(
    scene: EditScene, place: Path, tmp_path: Path
) -> None:
    given = task(scene, place, tmp_path / "work")
    stage = WholeObjectStage(given.own, Fantasia3dSettings())
    assert fit_error(stage) < 1
    start = stage.surface()
    assert len(start.faces) == len(given.own.base_surface.faces)
    edited = BASELINES.make(Choice.of("fantasia3d"), "here", given)
    assert edited.fit["fit_cells"] < 1 and edited.guidance_calls == given.guidance_calls == 4
    after = float(edited.images(VIEWS, 24).mask.mean())
    before = float(mesh_images((start.vertices.detach(), start.faces), VIEWS, 24).mask.mean())
    assert after > 1.02 * before
    mesh = edited.mesh
    assert mesh is not None
    # Far from the focal region, on the animal's back, too: below 0 of the canonical frame's height.
    far = mesh.vertices[mesh.vertices[:, 1] < 0]
    started = start.vertices.detach().numpy()
    started = started[started[:, 1] < 0]
    assert np.ptp(far[:, 0]) > np.ptp(started[:, 0])


def test_voxe_global_fits_the_base_and_grows_where_the_guidance_wants_it(
    scene: EditScene, place: Path, tmp_path: Path
) -> None:
    free = task(scene, place, tmp_path / "free")
    options = VOXELS | {"learning_rate": 0.5}
    edited = BASELINES.make(Choice.of("voxe_global", options | {"lambda_correlation": 0.0}), "here", free)
    assert edited.fit["fit_psnr_db"] > 15 and edited.guidance_calls == free.guidance_calls == 4
    held = BASELINES.make(
        Choice.of("voxe_global", options | {"lambda_correlation": 1e9}), "here", task(scene, place, tmp_path / "held")
    )
    after, before = (float(images(VIEWS, 24).mask.mean()) for images in (edited.images, edited.base_images))
    assert after > 1.05 * before > 0
    base, _ = fitted_grid(VoxeGlobalSettings(**options), base_shown(scene), 0)
    away = [loss_correlation(found.grid.density, base.density).item() for found in (held, edited)]
    assert 1.5 * away[0] < away[1], "the correlation loss holds the grid to the base"
    assert edited.mesh is not None and edited.mesh.volume() > 0


def test_all_methods_are_asked_from_the_same_places_with_the_same_seeds(
    scene: EditScene, place: Path, tmp_path: Path
) -> None:
    asked = []
    for name, options in (("fantasia3d", {}), ("voxe_global", VOXELS)):
        given = task(scene, place, tmp_path / name, "geometry.steps=2")
        BASELINES.make(Choice.of(name, options), "here", given)
        asked.append(given.guidance.inner.asked)
    own = task(scene, place, tmp_path / "own", "geometry.steps=2")
    for step in range(2):
        own.own.step(step)
    asked.append(own.guidance.inner.asked)
    assert asked[0] == asked[1] == asked[2] and len(asked[0]) == 2


class MeanColour:
    """A judge that sees nothing but the mean colour."""

    name, version, geometry_pictures = "mean colour", "1", "normals"

    def images(self, pictures: torch.Tensor) -> torch.Tensor:
        return pictures.mean(dim=(2, 3))

    def texts(self, texts: list[str]) -> torch.Tensor:
        return torch.tensor([[1.0, len(text) / 20, 0.5] for text in texts])


def test_a_comparison_from_jobs_to_figures(
    place: Path, more: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fd_mitsuba.runs.geometry_outcome._write_turntable", lambda *_: None)
    monkeypatch.setattr("fd_mitsuba.baselines.view_consistency.LATTICE_SIDE", 48)  # plenty for 32 pixels
    monkeypatch.setattr(BASELINES, "_entries", dict(BASELINES._entries))

    @BASELINES.register("broken")
    def broken(settings: NoSettings, task: EditTask) -> EditedMesh:
        raise RuntimeError("a fault\nof many lines")

    @BASELINES.register("same")
    def same(settings: NoSettings, task: EditTask) -> EditedMesh:
        base = task.scene.base_canonical
        return EditedMesh(task.scene, as_mesh(base.vertices, base.faces))

    config = RunConfig.load(place / "tiny.toml", more)
    names = ["focaldreamer", "broken", "fantasia3d", "same"]
    wanted = compare_jobs([place / "scene.xml"], [Choice.of(name) for name in names], [3], config, tmp_path)
    protocol, said = CompareProtocol(12, 32), []
    found = compare(wanted, MeanColour(), protocol, tmp_path, said.append)
    scene_name = wanted[0].scene_name
    states = [outcome.state for outcome in found.outcomes]
    assert not found.whole and states == ["finished", "failed", "finished", "finished"]
    assert f"[2/4] {scene_name}-broken-3: failed: RuntimeError: a fault" in said
    ours, whole, unchanged = found.results
    # The base's own mesh is in our result as it is; a whole field is marched on a grid, and moves.
    assert ours["base"]["psnr_db"] > 60 > whole["base"]["psnr_db"] > 5
    assert 10 * ours["base"]["chamfer"] < whole["base"]["chamfer"]
    assert ours["seed"] == 3 and ours["cost"]["guidance_calls"] == whole["cost"]["guidance_calls"] == 4
    assert unchanged["part"]["leakage"] is None and unchanged["consistency"]["explained"] is None
    assert unchanged["clip"]["dir_dot"] == pytest.approx(0, abs=1e-3)
    assert ours["part"]["leakage"] is not None and ours["consistency"]["explained"] > 0.9

    record = json.loads((tmp_path / "compare.json").read_text())
    assert [job["state"] for job in record["jobs"]] == states
    assert record["jobs"][0]["result"] == ours
    with Image.open(tmp_path / "compare.png") as figure:
        assert figure.size == (5 * 160, 18 + 18 + len(SEEN_AT) * 160)
        # What is shown fills the tiles: all views are cut to what any of them shows.
        tiles = np.asarray(figure)[36:].max(axis=2).reshape(len(SEEN_AT), 160, 5, 160) > 60
        assert max(np.ptp(found) for found in np.nonzero(tiles.any(axis=(0, 2)))) > 120
    rows = compare_rows(found.results, found.methods)
    cells = {row[0]: dict(zip(compare_header(), row, strict=True)) for row in rows}
    assert cells["fantasia3d"]["paper CLIP_sim"] == "0.284" and cells["broken"]["results"] == "0"
    assert "| focaldreamer | 0.329 | 0.0519 |" in (tmp_path / "compare.md").read_text()
    page = (tmp_path / "compare.html").read_text()
    assert '<td>fantasia3d</td><td class="number">0.284</td>' in page and "RuntimeError: a fault" in page
    assert page.count('src="data:image/') == 1 and "http" not in page.replace("http-equiv", "")

    # What is finished is read again, and other settings are not mixed with it.
    monkeypatch.setattr(jobs_module, "measure", lambda *_: pytest.fail("measured again"))
    (known,) = compare(wanted[:1], MeanColour(), protocol, tmp_path, said.append).outcomes
    assert known.state == "skipped" and known.result == ours
    other = RunConfig.load(place / "tiny.toml", [*more, "geometry.steps=5"])
    (again,) = compare_jobs([place / "scene.xml"], [Choice.of("fantasia3d")], [3], other, tmp_path)
    (refused,) = compare([again], MeanColour(), protocol, tmp_path, said.append).outcomes
    assert refused.state == "failed" and "other settings" in refused.message


def test_jobs_as_processes_of_a_batch(place: Path, tmp_path: Path) -> None:
    """A process is told the same job in words; one that fails costs its own result, and is not tried again."""
    words = ["compare", str(place / "scene.xml"), "--methods", "fantasia3d {lambda_volume = 2.0}", "--seeds", "4"]
    words += ["-c", str(place / "tiny.toml"), "--set", "geometry.steps=5", "-o", str(tmp_path)]

    def jobs_of(words: list[str]) -> tuple[list[CompareJob], argparse.Namespace, list[Choice]]:
        options = command_parser().parse_args(words)
        methods = [read_choice(text) for text in options.methods]
        scenes, config = [Path(scene) for scene in options.scenes], chosen_settings(options).config
        return compare_jobs(scenes, methods, options.seeds, config, Path(options.output)), options, methods

    (job,), options, methods = jobs_of([*words, "--views", "12", "--size", "32", "--workers", "2"])
    process = process_of(options, methods)(job)
    (same,), given, _ = jobs_of(process.words(1))
    assert (same.task_key(), same.folder) == (job.task_key(), job.folder)
    assert given.one and (given.views, given.size, given.threads) == (12, 32, 1)

    protocol, said = CompareProtocol(12, 32), []
    broken = (sys.executable, "-c", "print('fd_mitsuba: error: it broke'); exit(1)")
    outcomes = run_processes(
        [job], process_of(options, methods), MeanColour(), protocol, tmp_path, 2, 1, said.append, broken
    )
    assert [(outcome.state, outcome.message) for outcome in outcomes] == [("failed", "it broke")]
    found = compare([job], MeanColour(), protocol, tmp_path, said.append, tried={job.name: "it broke"})
    assert not found.whole and said[-1] == f"[1/1] {job.name}: failed: it broke" and not job.folder.exists()


def test_bad_input_is_one_line(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["-o", str(tmp_path / "out"), "-t", "1"]
    for more, expected in (
        (["--methods", "fantasia"], "--methods: unknown method 'fantasia'; nearest: fantasia3d"),
        (["--methods", "fantasia3d", "fantasia3d"], "is named twice"),
        (["--methods", "voxe_global {samples = 0}"], "--methods (voxe_global): samples"),
        (["--views", "2"], "give 4 to 1000 views"),
    ):
        assert main(["compare", str(place / "scene.xml"), *words, *more]) == 1
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and expected in lines[0]
    assert main(["compare", str(place / "nowhere"), *words]) == 1
    assert "no such scene" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["builtin", "sd15", "sd21", "ip2p"])
def test_three_steps_of_every_method_with_every_layout(
    kind: str, scene: EditScene, place: Path, tmp_path: Path
) -> None:
    """Both phases where the model is a real one's layout; Vox-E's cut needs its cross-attention, too."""
    model = "builtin" if kind == "builtin" else str(save_pipeline(kind, tmp_path / kind))
    coarse = "1.0" if kind == "builtin" else "0.67"
    overrides = [
        f"guidance.model={model}",
        "geometry.steps=3",
        f"geometry.coarse_fraction={coarse}",
        "geometry.views=4",
    ]
    config = RunConfig.load(place / "tiny.toml", overrides)
    seen = {"attention_views": 2}
    methods = {"fantasia3d": {}, "dreameditor": seen, "voxe_global": VOXELS, "voxe": VOXELS | seen}
    for name, options in methods.items():
        given = EditTask(scene, config, tmp_path / name, lambda line: None)
        edited = BASELINES.make(Choice.of(name, options), "here", given)
        # Two views whose attention is recorded, or two draws of noise for each.
        extra = 0 if options is not seen and name != "voxe" else 4 if kind == "builtin" else 2
        assert given.guidance.calls == 3 and edited.guidance_calls == 3 + extra
        images = edited.images(VIEWS, 24)
        assert images.values.isfinite().all() and images.mask.max() > 0.9
    assert 0 < edited.fit["edited_share"] < 1
    # What is not labelled is the base's again: less is changed than without the refinement.
    base, _ = fitted_grid(VoxeGlobalSettings(**VOXELS), base_shown(scene), 0)
    same = (edited.grid.density == base.density).float().mean()
    assert same > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["builtin", "ip2p"])
def test_three_updates_of_instruct_nerf2nerf(kind: str, scene: EditScene, place: Path, tmp_path: Path) -> None:
    """The guidance model edits normals; a pipeline edits the base under its light, and the grid has colours."""
    model = "" if kind == "builtin" else str(save_pipeline(kind, tmp_path / kind))
    config = RunConfig.load(place / "tiny.toml", ["guidance.model=builtin", "geometry.steps=6"])
    options = VOXELS | {"model": model, "sampling_steps": 2, "views": 3, "update_steps": 5}
    given = EditTask(scene, config, tmp_path / "work", lambda line: None)
    edited = BASELINES.make(Choice.of("in2n", options), "here", given)
    assert edited.guidance_calls == 6 and edited.fit["fit_psnr_db"] > 15
    base, images = edited.base_images(VIEWS, 24), edited.images(VIEWS, 24)
    assert images.kind == base.kind == ("colour" if model else "normals")
    assert images.values.isfinite().all() and images.mask.max() > 0.9
    # Another call finds the last checkpoint, the edited images in it, and edits nothing more.
    again = BASELINES.make(
        Choice.of("in2n", options), "here", EditTask(scene, config, tmp_path / "work", lambda _: None)
    )
    assert torch.equal(again.grid.density, edited.grid.density)


def test_in2n_asks_for_an_editor_where_the_guidance_is_none(scene: EditScene, place: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="name an image editor"):
        BASELINES.make(Choice.of("in2n", VOXELS), "here", task(scene, place, tmp_path))


def test_a_guidance_without_attention_is_refused_before_anything_is_made(
    scene: EditScene, place: Path, tmp_path: Path
) -> None:
    given = task(scene, place, tmp_path / "work")
    with pytest.raises(UserError, match="needs a diffusion model"):
        BASELINES.make(Choice.of("voxe", VOXELS), "here", given)
    assert not (tmp_path / "work").exists() and given.guidance_calls == 0
