"""The shipped scenes that the built-in prior cannot read run to the end with a model of Stable Diffusion's layout.

Its weights are random, so nothing is said about what grows: real weights are not at hand.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_pipelines import save_pipeline

from fd_mitsuba.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.mark.parametrize("name", ["cup_straw", "stump_butterfly"])
def test_scene_runs_to_its_report(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    model = save_pipeline("sd15", tmp_path / "sd15")
    words = ["run", str(ROOT / "scenes" / name / "scene.xml"), "-c", str(ROOT / "configs" / "smoke.toml"), "-t", "1"]
    words += ["--set", f"guidance.model={model}", "--set", "output.texture_size=128", "-o", str(tmp_path / "run")]
    assert main(words) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert set(metrics["stages"]) == {"geometry", "appearance"} and metrics["base_identical"]
    assert metrics["part_volume"] > 0 and metrics["manifold"]
    assert (tmp_path / "run" / "export" / "asset.glb").is_file() and (tmp_path / "run" / "report.html").is_file()
    assert "vocabulary" not in capsys.readouterr().err  # a model without a list of words ignores none of them
