"""Wings of feathers and of skin."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import jitter
from fd_mitsuba.prior.data.fine.grown import both
from fd_mitsuba.prior.data.fine.headwear import Rng, Zones
from fd_mitsuba.prior.data.fine.shapes import cone, sheet, strip, unit
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import Solid, tube


def _arm(surface: Surface, rng: Rng, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """The +x wing's leading edge (count, 3) from shoulder to tip, where its feathers trail (3,), and its span."""
    body = surface.body
    reach = float(np.clip(body.reach, 0.45, 1.0))
    span = jitter(rng, 1.08) * reach
    share = np.linspace(0, 1, count)
    if body.upright:
        root = body.back + np.array([0.35 * body.back_half_width, 0, 0.02])
        lift = np.deg2rad(rng.uniform(52, 68) - 75 * share**1.2)
        trail = np.array([0.12, -1.0, -0.12])
        sweep_back = -0.22 * span * share
    else:
        root = body.back + np.array([0.5 * body.back_half_width, -0.03, 0])
        lift = np.deg2rad(rng.uniform(52, 66) - 38 * share)
        trail = np.array([0.1, -0.22, -1.0])
        sweep_back = span * (0.22 * np.sin(np.pi * share) - 0.12 * share)
    step = span * np.diff(share, prepend=0)
    line = np.stack([np.cumsum(step * np.cos(lift)), np.cumsum(step * np.sin(lift)), sweep_back], 1)
    return root + line, unit(trail), span


def wings(surface: Surface, rng: Rng) -> Zones:
    """Two wings of feathers: an arm along the front edge and three rows that overlap like tiles."""
    line, trail, span = _arm(surface, rng, 25)
    chord = jitter(rng, 0.62) * span
    tip_way = unit(unit(line[-1] - line[-6]) + 0.55 * trail)
    normal = unit(np.cross(line[12] - line[0], trail))
    arm = tube(line[:-4], span * np.interp(np.linspace(0, 1, 21), [0, 0.5, 1], [0.062, 0.05, 0.03]), 10)
    rows = {"primaries": [], "coverts": []}
    for zone, count, long, lift_off, thick in (
        ("primaries", 11, 1.0, 0.0, 0.013),
        ("coverts", 9, 0.56, 0.014, 0.02),
        ("coverts", 8, 0.3, 0.024, 0.026),
    ):
        for s in np.linspace(0.06, 1, count):
            at = line[int(round(s * 24 * (0.98 if zone == "primaries" else 0.86)))]
            way = unit((1 - s**1.6) * trail + s**1.6 * tip_way)
            length = chord * long * np.interp(s, [0, 0.4, 0.75, 1], [0.62, 0.88, 1.08, 0.95])
            wide = 0.62 * span / count * (1.0 if zone == "primaries" else 1.1)
            t = np.linspace(0, 1, 6)
            bow = 0.05 * length * np.sin(np.pi * t)[:, None] * normal
            points = at + t[:, None] * length * way + bow
            half = wide * np.array([0.7, 0.95, 1.0, 1.0, 0.85, 0.3])
            across = np.cross(normal, way)
            rows[zone].append(strip(points, across, half, (thick + lift_off) * span, 8))
    return {
        "feathers": both(*rows["primaries"]),
        "coverts": both(arm, *rows["coverts"]),
    }


def bat_wings(surface: Surface, rng: Rng) -> Zones:
    """Two wings of skin between long fingers, with a scalloped edge behind and a claw at the wrist."""
    line, trail, span = _arm(surface, rng, 25)
    wrist_at = 13
    wrist, shoulder = line[wrist_at], line[0]
    chord = jitter(rng, 0.85) * span
    tip = line[-1] + 0.1 * span * unit(line[-1] - line[-4])
    ways = [
        unit(tip - wrist),
        unit(0.75 * unit(tip - wrist) + 0.6 * trail),
        unit(0.25 * unit(tip - wrist) + 0.9 * trail),
    ]
    ends = [tip, wrist + 1.02 * chord * ways[1], wrist + 0.95 * chord * ways[2]]
    inner = shoulder + 0.62 * chord * trail
    normal = unit(np.cross(line[12] - line[0], trail))

    def membrane(edge_a: np.ndarray, edge_b: np.ndarray, scallop: float) -> Solid:
        """Skin between two edges (n, 3), whose outer rim is drawn in by `scallop`."""
        u = np.linspace(0, 1, 7)[None, :, None]
        t = np.linspace(0, 1, len(edge_a))[:, None, None]
        grid = edge_a[:, None] * (1 - u) + edge_b[:, None] * u
        middle = (edge_a[0] + edge_b[0]) / 2
        grid = grid + (middle - grid) * scallop * (4 * u * (1 - u)) * t**2
        grid = grid - 0.05 * span * (4 * u * (1 - u)) * np.sin(np.pi * t * 0.8) * normal
        return sheet(grid, 0.035 * span)

    def edge(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a + np.linspace(0.0, 1, 8)[:, None] * (b - a)

    arm_edge = np.linspace(0.0, 1, 8)[:, None]
    skins = [
        membrane(edge(wrist, ends[0]), edge(wrist, ends[1]), 0.3),
        membrane(edge(wrist, ends[1]), edge(wrist, ends[2]), 0.3),
        membrane(shoulder + arm_edge * (inner - shoulder), edge(wrist, ends[2]), 0.22),
    ]
    bones = [tube(line[: wrist_at + 1 : 3], np.linspace(0.055, 0.045, 5) * span, 10)]
    bones += [tube(edge(wrist, end)[::2], np.array([0.036, 0.031, 0.027, 0.022]) * span, 8) for end in ends]
    claw = cone(wrist, wrist + 0.16 * span * unit(unit(wrist - shoulder) - 0.6 * trail), 0.036 * span)
    return {"skin": both(*skins), "bones": both(*bones, claw)}
