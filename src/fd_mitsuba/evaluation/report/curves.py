"""Loss curves as SVG: a line of means, and behind it the band between lowest and highest value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

_WIDTH, _HEIGHT, _LEFT, _TOP, _BOTTOM = 320, 132, 6, 14, 18
_POINTS = 160
_LOG_FROM = 50.0
_LEFT_OUT = {"stage", "phase", "step", "seconds", "guidance_loss", "guidance_timestep", "loss"}
_TITLES = {
    "loss_sds": "guidance (score distillation)",
    "loss_focal": "focal loss: stay in the region",
    "loss_collision": "collision with the base",
    "loss_volume": "volume",
    "loss_style_gradient": "style: gradients",
    "loss_style_boundary": "style: boundary",
    "guidance_gradient_mean": "guidance gradient, mean",
    "guidance_gradient_max": "guidance gradient, largest",
    "part_faces": "faces of the part",
}


@dataclass(frozen=True)
class Curve:
    """One chart."""

    title: str
    name: str
    """As in `metrics.jsonl`."""
    svg: str
    last: float


def stage_curves(rows: Sequence[dict]) -> list[Curve]:
    """A chart for each number that changes over the rows of one stage, losses first."""
    names = dict.fromkeys(name for row in rows for name in row if name not in _LEFT_OUT)
    found = []
    for name in sorted(names, key=lambda name: (not name.startswith("loss"), not name.startswith("guidance"))):
        points = [
            (float(row["step"]), float(row[name]), str(row.get("phase", "")))
            for row in rows
            if isinstance(row.get(name), int | float) and math.isfinite(row[name]) and "step" in row
        ]
        if len(points) >= 2 and len({value for _, value, _ in points}) > 1:
            title = _TITLES.get(name) or name.replace("_", " ")
            found.append(Curve(title, name, curve_svg(points, title), points[-1][1]))
    return found


def curve_svg(points: Sequence[tuple[float, float, str]], title: str) -> str:
    """An SVG of (step, value, phase), at least two; logarithmic where all values are positive and range widely."""
    values = [value for _, value, _ in points]
    logarithmic = min(values) > 0 and max(values) / min(values) > _LOG_FROM
    measure = math.log10 if logarithmic else float
    low, high = measure(min(values)), measure(max(values))
    first, last = points[0][0], points[-1][0]

    def x(step: float) -> float:
        return _LEFT + (step - first) / max(last - first, 1e-9) * (_WIDTH - 2 * _LEFT)

    def y(value: float) -> float:
        return _HEIGHT - _BOTTOM - (measure(value) - low) / max(high - low, 1e-12) * (_HEIGHT - _TOP - _BOTTOM)

    size = math.ceil(len(points) / _POINTS)
    buckets = [points[start : start + size] for start in range(0, len(points), size)]
    middles = [sum(step for step, _, _ in bucket) / len(bucket) for bucket in buckets]
    tops = [(x(step), y(max(v for _, v, _ in bucket))) for step, bucket in zip(middles, buckets, strict=True)]
    floors = [(x(step), y(min(v for _, v, _ in bucket))) for step, bucket in zip(middles, buckets, strict=True)]
    means = [sum(v for _, v, _ in bucket) / len(bucket) for bucket in buckets]
    line = [(x(step), y(value)) for step, value in zip(middles, _smooth(means), strict=True)]
    pieces = [f'<polygon class="band" points="{_path(tops + floors[::-1])}"/>' if size > 1 else ""]
    pieces += [f'<polyline class="raw" points="{_path([(x(s), y(v)) for s, v, _ in points])}"/>' if size == 1 else ""]
    pieces.append(f'<polyline class="mean" points="{_path(line)}"/>')
    for before, after in zip(points, points[1:], strict=False):
        if before[2] != after[2]:
            at = x(after[0])
            pieces.append(f'<line class="phase" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{_HEIGHT - _BOTTOM}"/>')
            pieces.append(f'<text x="{at + 3:.1f}" y="{_TOP + 9}">{escape(after[2])}</text>')
    scale = " (log)" if logarithmic else ""
    floor = _HEIGHT - _BOTTOM
    pieces.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDTH - _LEFT}" y1="{floor}" y2="{floor}"/>')
    pieces.append(f'<text x="{_LEFT}" y="{_TOP - 4}">{max(values):.3g}{scale}</text>')
    pieces.append(f'<text x="{_LEFT}" y="{_HEIGHT - 5}">lowest {min(values):.3g}</text>')
    pieces.append(f'<text class="end" x="{_WIDTH - _LEFT}" y="{_HEIGHT - 5}">step {last:.0f}</text>')
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img"><title>{escape(title)}: {values[0]:.4g} at step '
        f"{first:.0f}, {values[-1]:.4g} at step {last:.0f}</title>{''.join(pieces)}</svg>"
    )


def _smooth(values: Sequence[float]) -> list[float]:
    """A running mean over a twentieth of the chart."""
    reach = len(values) // 40
    windows = (values[max(0, i - reach) : i + reach + 1] for i in range(len(values)))
    return [sum(window) / len(window) for window in windows]


def _path(points: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
