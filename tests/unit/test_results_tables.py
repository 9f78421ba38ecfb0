"""Measured runs find their way into docs/results.md, and its bars are computed from them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
SCRIPT, PAGE = ROOT / "benchmarks" / "results_tables.py", ROOT / "docs" / "results.md"


def run(scene: str, seed: int, folder: Path, rank: int = 1, leakage: float = 0.0, drift: float = 0.0) -> dict:
    """One evaluation; its sheet of pictures is white in the row of the result."""
    sheet = np.zeros((3 * 8, 8 * 8, 3), np.uint8)
    sheet[16:] = 255
    (folder / "images").mkdir(parents=True)
    Image.fromarray(sheet).save(folder / "images" / "evaluation.png")
    ranks = {"rank": rank, "rank_start": 2, "rank_dir": 1, "rank_dir_start": 3}
    return {
        "scene": scene,
        "seed": seed,
        "run": str(folder),
        "judge": "a judge",
        "views": {"kind": "lit"},
        "clip": {"sim": 0.3 + 0.1 * seed, "dir_dot": 0.05, "dir_cosine": 0.2},
        "retrieval": ranks,
        "retrieval_with_base": ranks,
        "retrieval_parts": ranks,
        "base": {
            "identical": True,
            "missing": [],
            "files": 2,
            "files_identical": 2,
            "chamfer": 1e-17,
            "texture_difference": 0.0,
            "psnr_db": 200.0 if drift == 0 else 50.0,
            "colour_drift": drift,
        },
        "part": {"leakage": leakage, "overlap": 0.02, "parts": {"horn": {"lost": False, "valid": True}}},
        "boundary": {"colour_step": 0.1},
        "cost": {"seconds": 100.0, "peak_memory_mb": 900},
    }


@pytest.fixture
def filled(tmp_path: Path) -> str:
    """The page after two calls: five runs end, one fails; one of five ranks second, one leaks, one drifts."""
    runs = [run("cat", seed, tmp_path / f"cat{seed}") for seed in range(3)]
    runs.append(run("mug", 0, tmp_path / "mug0", rank=2, leakage=0.02))
    runs.append(run("mug", 1, tmp_path / "mug1", drift=0.01))
    for one, excess in zip(runs, (None, -0.1, 0.4, 0.6), strict=False):
        one["multi_face"] = {"excess": excess}
    states = ["finished"] * 4 + ["skipped", "failed"]
    (tmp_path / "runs" / "evaluate").mkdir(parents=True)
    (tmp_path / "runs" / "evaluate.json").write_text(json.dumps({"runs": runs}))
    shapes = [{**runs[0], "views": {"kind": "normals"}, "base": {**runs[0]["base"], "psnr_db": 60.0}}]
    (tmp_path / "runs" / "evaluate_shape.json").write_text(json.dumps({"runs": shapes}))
    rows = [{"name": f"job-{i}", "state": s, "message": "it vanished", "seed": 0} for i, s in enumerate(states)]
    rows.append({**rows[-1], "name": "job-6", "seed": 7})  # of seeds that nobody has evaluated
    (tmp_path / "runs" / "evaluate" / "batch.json").write_text(json.dumps({"jobs": rows}))
    ablation = tmp_path / "runs" / "ablate_cat"
    ablation.mkdir()
    leaks = {"full": 0.01, "no_focal": 0.04, "no_collision": 0.01, "paper": 0.0, "paper_no_focal": 0.001}
    rows = [
        {"row": {"name": name}, "shape": [run("cat", 0, tmp_path / name, leakage=leak)], "lit": []}
        for name, leak in leaks.items()
    ]
    rows[0]["lit"] = [run("cat", 0, tmp_path / "full_lit")]
    rows.append({"row": {"name": "single_path"}, "shape": [], "lit": [run("cat", 0, tmp_path / "single", drift=0.1)]})
    rows[2]["shape"][0]["part"]["overlap"] = 0.08
    (ablation / "ablation.json").write_text(json.dumps({"rows": rows}))
    (ablation / "ablation.md").write_text("| run | of the ablation |\n")
    page = tmp_path / "docs" / "results.md"
    (page.parent / "images").mkdir(parents=True)
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    command = [sys.executable, str(SCRIPT), "--runs", str(tmp_path / "runs"), "--page", str(page)]
    for _ in range(2):  # a second time it replaces what the first wrote
        subprocess.run(command, check=True, capture_output=True, text=True)
    return page.read_text(encoding="utf-8")


def test_bars_and_tables_follow_from_the_runs(filled: str, tmp_path: Path) -> None:
    def bars_of(page: str) -> dict[str, list[str]]:
        rows = [[cell.strip() for cell in line.split("|")] for line in page.splitlines() if line.count("|") == 4]
        return {row[1]: row[2:4] for row in rows}

    shape = bars_of(filled.split("<!-- table: bars shape -->")[1].split("<!-- end -->")[0])
    mesh = shape["base preserved perfectly in all (its mesh; textures and pixels: lit)"]
    assert mesh == ["1 of 2 (50%)", "**no**"]  # the failed run; 60 dB is the fillet
    bars = bars_of(filled.split("<!-- table: bars lit -->")[1])
    assert bars["every run ends"] == ["5 of 6 (83%)", "**no**"]
    assert bars["prompt ranked first among all edit prompts in ≥ 80 %, by CLIP_sim"] == ["4 of 6 (67%)", "**no**"]
    assert bars["prompt ranked first in ≥ 80 %, by the change (CLIP_dir)"] == ["5 of 6 (83%)", "yes"]
    assert bars["... and for the start in ≤ 25 %"] == ["0 of 5 (0%)", "yes"]
    assert bars["base preserved perfectly in all"] == ["4 of 6 (67%)", "**no**"]
    assert bars["leakage ≤ 1 % in all"] == ["4 of 6 (67%)", "**no**"]
    assert bars["most back views taken for the front in ≤ 5 % of the runs"] == ["1 of 5 (20%)", "**no**"]
    assert bars["without L_GF leakage grows ≥ 5 times"] == ["1.00% → 4.00%, 4.0 times", "**no**"]
    assert bars["without L_CA overlap grows ≥ 3 times"] == ["2.00% → 8.00%, 4.0 times", "yes"]
    assert bars["without L_GF leakage grows ≥ 5 times, the paper's losses alone"] == ["0.00% → 0.10%", "yes"]
    assert bars["without the dual path the base's colour drifts"] == ["0.00000 → 0.10000", "yes"]
    assert "without L_SC the boundary step is higher" not in bars  # it was not run
    assert "| cat | 3 | a judge, lit | 0.400 ± 0.100 | 0.0500 ± 0.0000 | 0.200 ± 0.000 |" in filled
    assert filled.count("- job-5: it vanished") == 1 and "job-0" not in filled and "job-6" not in filled
    assert "| ours, built-in prior (5 runs) | a judge, lit | 0.380" in filled and "0.0519" in filled
    assert filled.count("| run | of the ablation |") == 1 and "Not measured yet" not in filled
    sheet = np.asarray(Image.open(tmp_path / "docs" / "images" / "results_lit.jpg"))
    assert sheet[2, 4].max() < 60 and sheet[2, 16 + 8].min() > 200  # the start's two views, then the result's


def test_what_is_missing_leaves_the_page_alone(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    command = [sys.executable, str(SCRIPT), "--runs", str(tmp_path), "--page", str(page)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "nothing written" in said and page.read_bytes() == PAGE.read_bytes()
