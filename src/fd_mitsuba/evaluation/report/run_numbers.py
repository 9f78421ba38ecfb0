"""What a run's page says in numbers: seed and model, the metrics that tell most, the verdict, the time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from fd_mitsuba.evaluation.report.metric_table import duration
from fd_mitsuba.evaluation.report.run_record import RunRecord


class Titled(NamedTuple):
    """A picture's data URI, or a figure's text, and what it is."""

    title: str
    uri: str = ""
    text: str = ""


def chips(run: RunRecord) -> list[str]:
    """What it was made with, a few words each."""
    guidance = run.settings.get("guidance")
    model = guidance.get("model") if isinstance(guidance, dict) else None
    return [
        *([f"seed {run.settings['seed']}"] if "seed" in run.settings else []),
        *([f"guidance: {model}"] if model else []),
        *(f"{name} {rows[-1].get('step')} steps" for name, rows in run.rows.items() if rows),
    ]


def tiles(run: RunRecord) -> list[Titled]:
    """The metrics that tell most, each with what it is."""
    metrics, found = run.metrics, []

    def tile(name: str, title: str, form: Callable[[float], str]) -> None:
        value = metrics.get(name)
        value = metrics.get("appearance", {}).get(name) if value is None else value
        if isinstance(value, int | float):
            found.append(Titled(title, text=form(value)))

    tile("inside_fraction", "of the part inside its region", "{:.1%}".format)
    tile("overlap_fraction", "of the part inside the base", "{:.1%}".format)
    tile("base_identical", "base unchanged, byte for byte", lambda value: "yes" if value else "no")
    tile("base_psnr_db", "base outside the part, PSNR", lambda value: "exact" if value >= 199 else f"{value:.0f} dB")
    faces = metrics.get("part_faces", {})
    if faces and all(isinstance(count, int) for count in faces.values()):
        found.append(Titled("faces of the part", text=f"{sum(faces.values()):,}"))
    clip = run.evaluation.get("clip")
    if isinstance(clip, dict):
        for name, title in (("sim", "CLIP similarity"), ("dir_dot", "CLIP direction")):
            if isinstance(clip.get(name), float):
                found.append(Titled(f"{title}, judge {clip.get('judge', 'unknown')}", text=f"{clip[name]:.3f}"))
    spent = sum(run.seconds().values())
    if spent:
        found.append(Titled("in the steps of all stages", text=duration(spent)))
    return found


def verdict(run: RunRecord) -> dict | None:
    """What the evaluator says of the part, where it was asked."""
    said = run.metrics.get("verdict")
    return said if isinstance(said, dict) and isinstance(said.get("line"), str) else None


def timings(run: RunRecord) -> dict[str, str]:
    """What took how long."""
    found = {}
    for stage, seconds in run.seconds().items():
        count = len(run.rows[stage])
        found[f"{stage} steps"] = f"{duration(seconds)} ({count} steps, {seconds / max(count, 1):.2f} s each)"
    if isinstance(run.metrics.get("seconds"), int | float):
        found["last session, pictures and exports included"] = duration(run.metrics["seconds"])
    return found
