"""Procedural solids of revolution: vases, mugs, pumpkins, balls."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, finish, jitter
from fd_mitsuba.prior.data.primitives import ellipsoid, lathe


def vessel(rng: np.random.Generator, profile: list[tuple[float, float]], swell: float) -> Body:
    """A solid of revolution; heights in [0, 2]. The head is its rim."""
    wide, tall = jitter(rng, 1.0), jitter(rng, 1.0)
    rows = [(r * wide * (1 + swell * rng.uniform(-1, 1)), y * tall) for r, y in profile]
    middle = int(np.argmax([r for r, _ in rows]))
    radius, height = max(r for r, _ in rows), rows[-1][1]
    rim = max(rows[-1][0], 0.2 * radius)
    waist = height * 0.5
    return finish(
        [lathe(rows)],
        head_top=(0, height, 0),
        head_radius=max(rim, 0.35 * radius),
        forehead=(0, height * 0.97, rim * 0.6),
        horn_direction=(0, 0.8, 0.6),
        back=(0, height * 0.68, -radius * 0.75),
        back_half_width=radius * 0.4,
        reach=height * 0.5,
        side=(float(np.interp(waist, [y for _, y in rows], [r for r, _ in rows])), waist, 0),
        side_height=height * 0.6,
        bottom=0.0,
        foot_x=rows[0][0],
        foot_z=max(radius, rows[middle][0]) * 0.9,
        upright=True,
        foot_centre_z=0.0,
    )


def ball(rng: np.random.Generator) -> Body:
    squash = rng.uniform(0.85, 1.1)
    return finish(
        [ellipsoid((0, squash, 0), (1, squash, 1))],
        head_top=(0, 2 * squash, 0),
        head_radius=0.6,
        forehead=(0, 1.8 * squash, 0.58),
        horn_direction=(0, 0.8, 0.6),
        back=(0, squash * 1.3, -0.75),
        back_half_width=0.5,
        reach=1.0,
        side=(1, squash, 0),
        side_height=1.2,
        bottom=0.0,
        foot_x=0.5,
        foot_z=0.8,
        upright=True,
        foot_centre_z=0.0,
    )
