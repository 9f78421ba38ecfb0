"""Rows, jobs and tables of ablations and evaluations; the prompts that compete."""

from __future__ import annotations

from pathlib import Path

import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.ablation import FULL, ROWS, RowResult, ablation_jobs, chosen_rows
from fd_mitsuba.evaluation.ablation_table import ablation_header, ablation_rows
from fd_mitsuba.evaluation.report.score_table import (
    COLUMNS,
    header,
    markdown_table,
    mean_and_spread,
    scene_rows,
    score_rows,
    summary_lines,
)
from fd_mitsuba.evaluation.run_evaluation import Protocol, builtin_vocabulary
from fd_mitsuba.evaluation.scene_prompts import other_parts, prompts_of_scenes

ROOT = Path(__file__).resolve().parents[2]
QUICK = ROOT / "configs" / "quick.toml"


def test_rows_change_what_they_say() -> None:
    first, second = ablation_jobs(Path("scene.xml"), QUICK, [0, 2], ROWS, Path("out"), ["geometry.steps=7"])
    jobs = {job.name: job for job in (*first, *second)}
    assert len(jobs) == 2 * len(ROWS)
    full = jobs["full-2"].settings()
    assert full.seed == 2 and full.geometry.steps == 7 and full.appearance.style and jobs["full-2"].stage == "all"
    assert jobs["no_focal-0"].settings().geometry.lambda_focal == 0 and jobs["no_focal-0"].stage == "geometry"
    assert jobs["no_collision-0"].settings().geometry.lambda_collision == 0
    alone = jobs["paper_no_collision-0"].settings().geometry
    assert alone.lambda_collision == alone.lambda_volume == alone.lambda_presence == 0
    assert alone.lambda_tether == alone.lambda_curvature == 0
    assert alone.lambda_focal > 0
    assert jobs["paper-0"].settings().geometry.lambda_collision > 0 == jobs["paper-0"].settings().geometry.lambda_volume
    assert not jobs["no_style-0"].settings().appearance.style
    assert jobs["single_path-0"].settings().appearance.single_path
    ks = [jobs[f"{name}-0"].settings().geometry.union_k for name in ("k_0", "k_005", "k_015", "k_03", "k_05")]
    assert ks == [0, 0.05, 0.15, 0.3, 0.5]
    for job in second:  # a shape can be taken over only if no setting of the geometry differs
        assert job.geometry_from == Path("out") / f"full-{job.seed}"
        assert job.settings().content_hash("geometry") == jobs[f"full-{job.seed}"].settings().content_hash("geometry")
        assert job.settings().content_hash("appearance") != jobs[f"full-{job.seed}"].settings().content_hash(
            "appearance"
        )
    for job in first:
        changed = job.settings().content_hash("geometry") != jobs[f"full-{job.seed}"].settings().content_hash(
            "geometry"
        )
        # In the quick settings, k = 0.15 is the full method's own.
        assert changed == (job.name.rpartition("-")[0] not in (FULL, "k_015"))


def test_the_papers_table_2_stands_beside() -> None:
    paper = {row.name: row.paper for row in ROWS}
    assert paper["no_focal"] == ("0.316", "0.0433") and paper["no_collision"] == ("0.329", "0.0517")
    assert paper["no_style"] == ("0.312*", "0.0402*") and paper["single_path"] == ("0.313", "0.0401")
    assert "0.329" in paper["full"][0] and "0.0519" in paper["full"][1]


def test_rows_are_chosen_by_name() -> None:
    assert [row.name for row in chosen_rows(["single_path", "k_0"])] == ["full", "single_path", "k_0"]
    assert [row.name for row in chosen_rows(["single_path", "k_0"], "geometry")] == ["full", "k_0"]
    with pytest.raises(UserError, match="no_glue.*no_focal"):
        chosen_rows(["no_glue"])


def found(seed: int, sim: float, leakage: float) -> dict:
    return {
        "scene": "cat",
        "seed": seed,
        "judge": "a judge",
        "views": {"kind": "lit"},
        "clip": {"sim": sim, "dir_dot": 0.05},
        "part": {"leakage": leakage, "overlap": 0.0, "parts": {"part": {"valid": True}}},
    }


def test_tables_have_means_spreads_and_the_judge() -> None:
    columns = [COLUMNS[name] for name in ("sim", "leakage", "valid", "psnr")]
    rows = score_rows([found(0, 0.3, 0.01), found(1, 0.4, 0.03)], columns)
    assert rows[0] == ["cat", "0", "a judge, lit", "0.300", "1.0%", "100%", "-"]
    assert rows[2] == ["all 2", "", "a judge, lit", "0.350 ± 0.071", "2.0% ± 1.4%", "100% ± 0%", "-"]
    assert scene_rows([found(0, 0.3, 0.01), found(1, 0.4, 0.03)], columns)[0][:2] == ["cat", "2"]
    lines = summary_lines([found(0, 0.3, 0.01), found(1, 0.4, 0.03)])
    assert lines[0] == "CLIP_dir above 0: 2 of 2 runs (100%)" and "leakage at most 1 %: 1 of 2 runs (50%)" in lines
    assert mean_and_spread([None, 2.0]) == (2.0, None) and mean_and_spread([]) == (None, None)
    lines = markdown_table(header(columns), rows).splitlines()
    assert len(lines) == 5 and all(line.count("|") == 8 for line in lines)
    results = [RowResult(ROWS[0], (Path("a"), Path("b")), (found(0, 0.3, 0.01), found(1, 0.4, 0.03)), ())]
    results.append(RowResult(ROWS[1], (), (), ()))
    cells = [dict(zip(ablation_header(), row, strict=True)) for row in ablation_rows(results)]
    assert (
        cells[0]["CLIP_sim ↑"] == "0.350 ± 0.071" and cells[0]["runs"] == "2" and cells[0]["leakage ↓"] == "2.0% ± 1.4%"
    )
    assert cells[1]["CLIP_sim ↑"] == "-" and cells[1]["paper CLIP_dir"] == "0.0433"


def test_rival_prompts_are_those_that_the_built_in_models_can_read() -> None:
    vocabulary = builtin_vocabulary()
    prompts = {found.name: found for found in prompts_of_scenes(ROOT / "scenes")}
    assert len(prompts) == 15
    assert {name for name, one in prompts.items() if not one.known_to(vocabulary)} == {"cup_straw", "stump_butterfly"}
    assert prompts["cat"].words.base_prompt == "a cat" and prompts["unicorn"].simple == "a horse with a horn"
    sentences, own = other_parts("a cute kitten with a golden crown", vocabulary)
    assert len(sentences) == len(vocabulary.parts) and sentences[own].prompt == "a cat with a crown"
    assert other_parts("a spoon", vocabulary) is None
    with pytest.raises(UserError, match="scene.xml"):
        prompts_of_scenes(ROOT / "configs")


def test_a_protocol_that_sees_nothing_is_refused() -> None:
    with pytest.raises(UserError, match="--views 0"):
        Protocol(views=0)
