"""Evaluations and ablations of tiny finished runs, with a judge that is known in closed form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_runs import FIELD, ORANGE_PART, TEXTURE, write_place

from fd_mitsuba.cli.main import main
from fd_mitsuba.evaluation import run_evaluation as evaluate
from fd_mitsuba.evaluation.ablation import ablate, ablation_jobs, chosen_rows
from fd_mitsuba.evaluation.ablation_table import ablation_header, ablation_rows, write_ablation_sheet
from fd_mitsuba.evaluation.clip import ClipJudge
from fd_mitsuba.runs import pipeline
from fd_mitsuba.scene.load_scene import load_edit_scene

SETTINGS = f"""
{FIELD}
[geometry]
steps = 2
grid_resolution = 16
lambda_sds = 0.0
focal_samples = 64
{TEXTURE}
[appearance]
steps = 2
views = 1
spp = 1
picture_size = 16
lambda_sds = 0.0
style_samples = 32
boundary_reach = 0.1
[output]
sheet_every = 0
checkpoint_every = 2
turntable_frames = 2
turntable_size = 16
picture_size = 16
texture_size = 16
"""


class Average:
    """Sees a picture as its mean colour, and a sentence as a colour that depends on its length."""

    name = "mean colour"
    version = "1"
    geometry_pictures = "normals"

    def images(self, pictures: torch.Tensor) -> torch.Tensor:
        return pictures.mean(dim=(2, 3))

    def texts(self, texts: list[str]) -> torch.Tensor:
        return torch.tensor([[1.0, len(text) / 20, 0.5] for text in texts])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    return write_place(tmp_path_factory.mktemp("evaluated"), animal, SETTINGS, part=ORANGE_PART)


@pytest.mark.slow
def test_an_ablation_from_runs_to_table(place: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    rows = chosen_rows(["no_focal", "single_path"])
    jobs = ablation_jobs(place / "scene.xml", place / "tiny.toml", [0], rows, place / "out")
    scene = load_edit_scene(place / "scene.xml")
    monkeypatch.setattr("fd_mitsuba.runs.geometry_outcome._write_turntable", lambda *_: None)
    for job in (*jobs[0], *jobs[1]):  # in this process: the batch then finds them finished
        stages = pipeline.STAGES if job.stage == "all" else ("geometry",)
        pipeline.run(scene, job.settings(), job.folder, False, "", True, lambda line: None, stages, job.geometry_from)
    said: list[str] = []
    protocol = evaluate.Protocol(4, 32, 2)
    results = ablate(jobs, rows, Average(), protocol, (), say=said.append)
    assert sum("skipped" in line for line in said) == 3
    full, no_focal, single = (result for result in results)
    assert [len(result.lit) for result in results] == [1, 0, 1] and [len(r.shape) for r in results] == [1, 1, 0]

    one = full.lit[0]
    metrics = json.loads((place / "out" / "full-0" / "metrics.json").read_text())
    assert one["part"]["leakage"] == 1 - metrics["inside_fraction"] and one["part"]["parts"]["part"]["valid"]
    assert one["cost"]["peak_memory_mb"] > 50 and one["cost"]["seconds"] == metrics["seconds"]
    assert one["base"]["psnr_db"] == 200 and one["base"]["colour_drift"] == 0 and one["base"]["chamfer"] < 1e-12
    assert one["base"]["identical"] and one["base"]["files"] == one["base"]["files_identical"] == 1
    assert one["views"] == {"kind": "lit", "count": 4, "size": 32, "elevation_deg": 45.0}
    assert {one[name]["judge"] for name in ("clip", "multi_face")} == {"mean colour"}
    assert full.shape[0]["views"]["kind"] == "normals" and full.shape[0]["base"]["psnr_db"] > 40
    assert 0 < one["boundary"]["colour_step"] < 1
    assert single.lit[0]["base"]["colour_drift"] > 0.01 and single.lit[0]["base"]["psnr_db"] < 60
    assert one["clip"]["dir_dot"] != 0 and one["clip"]["sim"] <= 1
    assert json.loads((place / "out" / "full-0" / "evaluation.json").read_text()) == one
    sheet = Image.open(place / "out" / "full-0" / "images" / "evaluation.png")
    assert sheet.size == (4 * 32, 3 * 32)

    cells = [dict(zip(ablation_header(), row, strict=True)) for row in ablation_rows(results)]
    assert [cell["run"] for cell in cells] == ["full method", "without L_GF", "without dual path"]
    assert cells[1]["CLIP_sim ↑"] == "-" != cells[1]["CLIP_sim ↑, shape"] and cells[1]["runs"] == "1"
    write_ablation_sheet(results, place / "out" / "ablation.png")
    assert Image.open(place / "out" / "ablation.png").size == (6 * 160, 3 * 178)

    # What is evaluated is not looked at again, until something that matters changes.
    def never(*_: object) -> None:
        raise AssertionError("rendered again")

    monkeypatch.setattr(evaluate, "lit_views", never)
    folder = place / "out" / "full-0"
    assert evaluate.evaluate_run(folder, Average(), protocol) == one
    with pytest.raises(AssertionError, match="again"):
        evaluate.evaluate_run(folder, Average(), evaluate.Protocol(5, 32, 2))

    monkeypatch.setattr(ClipJudge, "load", lambda model: Average())
    words = ["--views", "4", "--size", "32", "--spp", "2", "--scenes", str(place / "nowhere"), "-t", "1"]
    assert (
        main(["evaluate", str(folder), *words, "--json", str(place / "all.json"), "--markdown", str(place / "t.md")])
        == 0
    )
    assert "mean colour, lit" in capsys.readouterr().out
    assert json.loads((place / "all.json").read_text())["runs"] == [one]
    assert "| scene | seed | judge |" in (place / "t.md").read_text()
    assert main(["evaluate", str(place / "nothing"), *words]) == 1
    assert "metrics.json" in capsys.readouterr().err
