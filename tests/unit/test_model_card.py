"""Measured figures find their way into the model card."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CARD = ROOT / "src" / "fd_mitsuba" / "weights" / "MODEL_CARD.md"


def test_tables_are_filled_from_the_files_that_are_there(tmp_path: Path) -> None:
    row = {"samples": 36, "recall": 0.9, "recall_in_truth": 1.0, "body_named": 0.97, "body_named_in_truth": 0.99}
    row |= {"body_kept": None, "body_kept_in_truth": 0.86, "shape_kept": 0.95}
    report = {"per_part": {"horn": row}, "overall": row, "held_out": row, "plain": {"samples": 54, "unchanged": 0.98}}
    runs = tmp_path / "runs"
    (runs / "prior_in_3d").mkdir(parents=True)
    (runs / "prior_geometry.json").write_text(json.dumps(report))
    mean = {"cases": 2, "found": 0.5, "found_at_start": 0.1, "named_right": 0.5}
    cases = {
        "a": {
            "prompt": "a cat with horns",
            "untrained": True,
            "end": {"found": 0.75, "named": "horns"},
            "start": {"found": 0},
        },
        "b": {"prompt": "a dog with a horn", "untrained": False, "problem": "the part vanished"},
    }
    results = {"cases": cases, "all": mean, "trained": mean, "untrained": mean}
    (runs / "prior_in_3d" / "results.json").write_text(json.dumps(results))
    card = tmp_path / "card.md"
    card.write_text(CARD.read_text(encoding="utf-8"), encoding="utf-8")
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "model_card_tables.py"),
        "--runs",
        str(runs),
        "--card",
        str(card),
    ]
    for _ in range(2):  # a second time it replaces what the first wrote
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        text = card.read_text(encoding="utf-8")
        assert text.count("| horn | 36 | 90% | 100% | 97% | 99% | - | 86% | 95% |") == 1
        assert "unchanged in 98% of 54" in text
        assert "| a cat with horns (untrained) | 75% | 0% | horns |" in text
        assert "| a dog with a horn | - | - | the part vanished |" in text
        assert "| mean, all (2) | 50% | 10% | 50% right |" in text
    assert "colours: " in said and "is missing" in said
    colours = CARD.read_text(encoding="utf-8").split("<!-- table: colours -->")[1].split("<!-- end -->")[0]
    assert f"<!-- table: colours -->{colours}" in text
