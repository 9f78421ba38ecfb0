"""Bodies that are turned about an axis, and the tree: teapots, bottles."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, finish, jitter
from fd_mitsuba.prior.data.fine.shapes import curve, turned
from fd_mitsuba.prior.data.primitives import Solid, ellipsoid, lathe, tube

Rng = np.random.Generator


def _turned_body(
    rows: list[tuple[float, float]], more: list[Solid], top: float, radius: float, handle_at: float, wide: float
) -> Body:
    height = rows[-1][1]
    return finish(
        [lathe(rows, segments=30), *more],
        head_top=(0, top, 0),
        head_radius=radius,
        forehead=(0, 0.93 * top, 0.6 * radius),
        horn_direction=(0, 0.8, 0.6),
        back=(0, 0.62 * height, -0.8 * wide),
        back_half_width=0.4 * wide,
        reach=0.5 * height,
        side=(float(np.interp(handle_at, [y for _, y in rows], [r for r, _ in rows])), handle_at, 0),
        side_height=0.6 * height,
        bottom=0.0,
        foot_x=rows[0][0],
        foot_z=0.9 * wide,
        upright=True,
        foot_centre_z=0.0,
    )


def teapot(rng: Rng) -> Body:
    wide, tall = jitter(rng, 0.8), jitter(rng, 1.1)
    rows = [
        (0.6 * wide, 0),
        (0.7 * wide, 0.05 * tall),
        (wide, 0.4 * tall),
        (0.92 * wide, 0.68 * tall),
        (0.6 * wide, 0.92 * tall),
        (0.3 * wide, tall),
        (0.1 * wide, 1.02 * tall),
    ]
    spout = tube(
        curve([(0, 0.35 * tall, 0.85 * wide), (0, 0.5 * tall, 1.3 * wide), (0, 0.95 * tall, 1.6 * wide)], 8),
        np.linspace(0.22, 0.11, 8) * wide,
    )
    more = [spout, ellipsoid((0, 1.1 * tall, 0), (0.13 * wide,) * 3)]
    if rng.random() < 0.5:
        more.append(
            tube(
                curve(
                    [
                        (0, 0.8 * tall, -0.8 * wide),
                        (0, 0.9 * tall, -1.3 * wide),
                        (0, 0.5 * tall, -1.5 * wide),
                        (0, 0.25 * tall, -0.9 * wide),
                    ],
                    12,
                ),
                np.full(12, 0.085 * wide),
            )
        )
    return _turned_body(rows, more, 1.1 * tall + 0.12 * wide, 0.45 * wide, 0.5 * tall, wide)


def bottle(rng: Rng) -> Body:
    wide, tall, neck = jitter(rng, 0.42, 0.2), jitter(rng, 2.0), jitter(rng, 0.17, 0.25)
    shoulder = rng.uniform(0.5, 0.7) * tall
    rows = [
        (0.9 * wide, 0),
        (wide, 0.05),
        (wide, 0.5 * shoulder),
        (0.97 * wide, shoulder),
        (0.6 * wide, shoulder + 0.2),
        (neck, shoulder + 0.38),
        (neck, 0.95 * tall),
        (1.25 * neck, 0.955 * tall),
        (1.25 * neck, tall),
    ]
    return _turned_body(rows, [], tall, max(1.25 * neck, 0.22), 0.4 * tall, wide)


def tree(rng: Rng) -> Body:
    tall, trunk, crown = jitter(rng, 1.0), jitter(rng, 0.14, 0.3), jitter(rng, 0.62)
    solids = [tube([(0, 0.03, 0), (0, 0.2, 0), (0, tall + 0.3, 0)], [1.5 * trunk, trunk, 0.7 * trunk])]
    if rng.random() < 0.4:
        layers = 3
        for k in range(layers):
            base, wide = tall * (0.5 + 0.42 * k), crown * (1 - 0.24 * k)
            solids.append(turned([(0.02, base), (wide, base), (0.2 * wide, base + 0.62), (0.01, base + 0.7)]))
        top = tall * (0.5 + 0.42 * (layers - 1)) + 0.7
        radius = 0.26
    else:
        for _ in range(rng.integers(5, 9)):
            away = rng.normal(size=3) * (0.36, 0.26, 0.36) * crown
            solids.append(
                ellipsoid(np.array([0, tall + 0.7 * crown, 0]) + away, np.full(3, crown) * rng.uniform(0.5, 0.75))
            )
        solids.append(ellipsoid((0, tall + 0.7 * crown, 0), (0.85 * crown,) * 3))
        top = max(
            s.vertices[np.linalg.norm(s.vertices[:, ::2], axis=1) < 0.1 * crown, 1].max(initial=0) for s in solids
        )
        radius = 0.38
    return finish(
        solids,
        head_top=(0, top, 0),
        head_radius=radius,
        forehead=(0, tall + 1.0 * crown, 0.7 * crown),
        horn_direction=(0, 0.8, 0.6),
        back=(0, 0.85 * tall, -1.2 * trunk),
        back_half_width=0.25,
        reach=0.5 * top,
        side=(1.1 * trunk, 0.45 * tall, 0),
        side_height=0.6 * tall,
        bottom=0.0,
        foot_x=0.3,
        foot_z=0.5,
        upright=True,
        foot_centre_z=0.0,
    )
