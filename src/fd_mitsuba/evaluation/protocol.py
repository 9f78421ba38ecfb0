"""The evaluation of one finished run: 100 views of it and of its base, and every figure that follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.base_drift import export_drift, picture_drift
from fd_mitsuba.evaluation.front_in_back import front_in_back
from fd_mitsuba.evaluation.judged_views import ELEVATION_DEG, JudgedViews
from fd_mitsuba.evaluation.part_check import check_parts
from fd_mitsuba.evaluation.scene_prompts import other_parts
from fd_mitsuba.evaluation.similarity import EditPrompt, Judge, clip_scores, retrieval
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.scene.edit_scene import EditScene

FORMAT = 3
_MEASURED = (
    *("base_identical", "inside_fraction", "overlap_fraction", "part_volume", "manifold", "islands_removed", "gap"),
    "seconds",
)
"""What `metrics.json` has of every run."""


def judged(
    views: JudgedViews,
    judge: Judge,
    words: EditPrompt,
    simple: str | None,
    rivals: Sequence[EditPrompt],
    vocabulary: Vocabulary | None,
) -> dict:
    """What a judge says of the views; every group of figures names it.

    Args:
        words: the run's own.
        simple: the simplified prompt, if there is one.
        rivals: edit prompts of other scenes, that the run's own has to be found among.
        vocabulary: for sentences about the same body with other parts; None: none.
    """
    by = {"judge": judge.name, "kind": views.kind}
    edited, base, start = (judge.images(pictures) for pictures in (views.edited, views.base, views.start))
    clip = by | clip_scores(judge, edited, base, words)
    begun = clip_scores(judge, start, base, words)
    clip |= {f"{name}_start": begun[name] for name in ("sim", "dir_dot", "dir_cosine") if name in begun}
    found: dict = {"clip": clip}
    if simple is not None:
        found["clip_simple"] = by | {"prompt": simple}
        found["clip_simple"] |= clip_scores(judge, edited, base, EditPrompt(simple, words.base_prompt))
    others = [rival for rival in dict.fromkeys(rivals) if rival.prompt != words.prompt]
    unchanged = EditPrompt(words.base_prompt, words.base_prompt)
    for name, choice in {
        "retrieval": ([words, *others], 0) if others else None,
        "retrieval_with_base": ([words, *others, unchanged], 0) if others and words.base_prompt else None,
        "retrieval_parts": None if vocabulary is None else other_parts(words.prompt, vocabulary),
    }.items():
        if choice is not None:
            before = retrieval(judge, start, base, *choice)
            found[name] = by | retrieval(judge, edited, base, *choice)
            found[name] |= {f"{key}_start": value for key, value in before.items() if key != "candidates"}
    faces = front_in_back(edited, base, views.azimuth_deg)
    found["multi_face"] = by | ({} if faces is None else asdict(faces))
    return found


def measured_by_run(folder: Path) -> dict:
    """`metrics.json` of a run folder.

    Raises:
        UserError: it lacks something that every run has measured, or a number is none.
    """
    metrics = read_json_object(folder / "metrics.json") or {}
    missing = [name for name in _MEASURED if name not in metrics]
    numbers = [metrics.get(name) for name in ("inside_fraction", "overlap_fraction", "seconds")]
    if missing or not all(isinstance(number, int | float) for number in numbers):
        what = f"no {missing[0]}" if missing else "a metric is no number"
        raise UserError(f"{folder / 'metrics.json'}: is damaged ({what}); go on with the run by --resume")
    return metrics


def measured(scene: EditScene, folder: Path, views: JudgedViews, metrics: dict) -> dict:
    """What needs no judge: base, part, locality, cost; the last two as the run itself has measured them."""
    return {
        "base": {
            "identical": metrics["base_identical"],
            **({} if scene.subtracts else picture_drift(views)),
            **export_drift(scene, folder),
        },
        "part": {
            "leakage": 1.0 - metrics["inside_fraction"],
            "overlap": metrics["overlap_fraction"],
            "volume": metrics["part_volume"],
            "manifold": metrics["manifold"],
            "islands_removed": metrics["islands_removed"],
            "gap": metrics["gap"],
            "parts": check_parts(scene.parts, folder, scene.frame.scale),
        },
        "cost": {"seconds": metrics["seconds"], "peak_memory_mb": metrics.get("peak_memory_mb")},
    }


def about_views(views: JudgedViews) -> dict:
    """How the pictures were taken, for the record."""
    return {
        "kind": views.kind,
        "count": len(views.edited),
        "size": views.edited.shape[-1],
        "elevation_deg": ELEVATION_DEG,
    }
