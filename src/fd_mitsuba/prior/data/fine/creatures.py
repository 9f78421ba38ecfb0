"""Bodies of living things that only the finer prior knows: elephants, dragons, human heads."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, finish, jitter
from fd_mitsuba.prior.data.fine.shapes import cone, curve
from fd_mitsuba.prior.data.primitives import ellipsoid, mirror_x, rotation, tube

Rng = np.random.Generator


def elephant(rng: Rng) -> Body:
    length, girth, leg, head = jitter(rng, 0.62), jitter(rng, 0.52), jitter(rng, 0.62), jitter(rng, 0.36)
    barrel = leg + 0.75 * girth
    solids = [
        tube(
            [(0, barrel, -length), (0, barrel + 0.1 * girth, 0), (0, barrel + 0.05 * girth, length)],
            [girth * 0.9, girth, girth * 0.92],
        )
    ]
    thick = girth * rng.uniform(0.34, 0.42)
    for z in (-0.85 * length, 0.85 * length):
        side = tube([(0.58 * girth, barrel, z), (0.58 * girth, 0.9 * thick, z)], [thick * 1.1, thick])
        solids += [side, mirror_x(side)]
    at = np.array([0, barrel + 0.55 * girth, length + 0.85 * girth])
    solids.append(ellipsoid(at, (head * 0.9, head, head)))
    swing = rng.uniform(-0.1, 0.5)
    trunk = curve(
        [
            at + (0, -0.2 * head, 0.7 * head),
            at + (0, -0.9 * head, 1.4 * head),
            at + (0, -2.1 * head, 1.5 * head),
            at + (0, -2.5 * head + swing * head, 2.0 * head),
        ],
        12,
    )
    solids.append(tube(trunk, head * np.linspace(0.42, 0.17, 12)))
    ear = jitter(rng, 1.15) * head
    flap = ellipsoid(
        at + (head * 0.95 + 0.35 * ear, 0.1 * head, -0.15 * head),
        (0.75 * ear, ear, 0.12 * ear),
        rotation(degrees_y=rng.uniform(20, 55)),
    )
    tail = tube(
        [(0, barrel + 0.5 * girth, -length - 0.8 * girth), (0, barrel - 0.5 * girth, -length - girth)], [0.06, 0.05]
    )
    solids += [flap, mirror_x(flap), tail]
    return finish(
        solids,
        head_top=at + (0, head * 0.95, 0),
        head_radius=head * 0.85,
        forehead=at + (0, 0.62 * head, 0.75 * head),
        horn_direction=(0, 0.7, 0.7),
        back=(0, barrel + 0.95 * girth, 0.3 * length),
        back_half_width=0.55 * girth,
        reach=length + girth,
        side=(girth * 0.95, barrel, 0),
        side_height=girth * 1.5,
        bottom=0.0,
        foot_x=0.58 * girth + thick,
        foot_z=0.85 * length + thick,
        foot_centre_z=0.0,
    )


def dragon(rng: Rng) -> Body:
    length, girth, leg, head = jitter(rng, 0.55), jitter(rng, 0.34), jitter(rng, 0.42), jitter(rng, 0.22)
    neck = jitter(rng, 0.75, 0.25)
    barrel = leg + 0.7 * girth
    solids = [
        tube(
            [(0, barrel, -length), (0, barrel + 0.08 * girth, 0), (0, barrel + 0.2 * girth, length)],
            [girth * 0.8, girth, girth * 0.9],
        )
    ]
    thick = girth * 0.32
    for z in (-0.8 * length, 0.85 * length):
        side = tube(
            [(0.62 * girth, barrel, z), (0.85 * girth, 0.5 * leg, z + 0.1), (0.7 * girth, 0.8 * thick, z)],
            [thick * 1.4, thick, thick * 0.85],
        )
        toe = ellipsoid((0.7 * girth, 0.5 * thick, z + 0.8 * thick), (thick, 0.5 * thick, 1.2 * thick))
        solids += [side, mirror_x(side), toe, mirror_x(toe)]
    tilt = np.deg2rad(rng.uniform(45, 75))
    base = np.array([0, barrel + 0.4 * girth, length * 1.1])
    end = base + neck * np.array([0, np.sin(tilt), np.cos(tilt)])
    bow = base + 0.55 * neck * np.array([0, np.sin(tilt), 1.6 * np.cos(tilt)])
    solids.append(tube(curve([base, bow, end], 8), np.linspace(0.72 * girth, 0.75 * head, 8)))
    solids.append(ellipsoid(end, (head * 0.85, head * 0.8, head)))
    nose = end + np.array([0, -0.15 * head, head * rng.uniform(1.5, 2.1)])
    solids.append(tube([end + (0, -0.05 * head, 0.5 * head), nose], [head * 0.6, head * 0.36]))
    if rng.random() < 0.4:
        for sign in (1, -1):
            root = end + np.array([sign * 0.5 * head, 0.6 * head, -0.3 * head])
            solids.append(cone(root, root + head * np.array([sign * 0.3, 0.6, -0.9]), 0.2 * head))
    tail = curve(
        [
            (0, barrel, -length),
            (0, 0.7 * barrel, -length - 0.5),
            (rng.uniform(-0.3, 0.3), 0.35, -length - 1.0),
            (rng.uniform(-0.5, 0.5), 0.25, -length - 1.5),
        ],
        12,
    )
    solids.append(tube(tail, girth * np.linspace(0.75, 0.08, 12)))
    return finish(
        solids,
        head_top=end + (0, 0.78 * head, -0.1 * head),
        head_radius=0.8 * head,
        forehead=end + (0, 0.65 * head, 0.5 * head),
        horn_direction=(0, 0.85, 0.5),
        back=(0, barrel + 0.8 * girth, 0.3 * length),
        back_half_width=0.55 * girth,
        reach=length + girth,
        side=(girth * 0.95, barrel, 0),
        side_height=girth * 1.5,
        bottom=0.0,
        foot_x=0.75 * girth + thick,
        foot_z=0.85 * length + thick,
        foot_centre_z=0.0,
    )


def head(rng: Rng) -> Body:
    """A human head with nose, brows, lips, chin and ears on a neck, half of the time on shoulders."""
    wide, tall, deep = jitter(rng, 0.56, 0.08), jitter(rng, 0.76, 0.08), jitter(rng, 0.68, 0.08)
    y = 1.35
    solids = [
        ellipsoid((0, y + 0.12, -0.04), (wide, 0.82 * tall, deep)),
        ellipsoid((0, y - 0.28 * tall, 0.14), (0.78 * wide, 0.62 * tall, 0.72 * deep)),
        ellipsoid((0, y - 0.72 * tall, 0.42 * deep), (0.3 * wide, 0.16, 0.2)),
        tube([(0, y + 0.08 * tall, deep * 0.86), (0, y - 0.22 * tall, deep * rng.uniform(1.05, 1.2))], [0.07, 0.12]),
        tube([(0, 0.42, -0.12), (0, y - 0.3 * tall, -0.08)], [0.36, 0.32]),
        tube(
            [
                (-0.17, y - 0.46 * tall, deep * 0.84),
                (0, y - 0.45 * tall, deep * 0.9),
                (0.17, y - 0.46 * tall, deep * 0.84),
            ],
            [0.045, 0.065, 0.045],
        ),
    ]
    for sign in (1, -1):
        solids.append(ellipsoid((sign * wide, y - 0.05, -0.05), (0.08, 0.19, 0.12), rotation(degrees_y=sign * 20)))
        solids.append(
            tube([(sign * 0.1, y + 0.2 * tall, deep * 0.9), (sign * 0.36, y + 0.21 * tall, deep * 0.74)], [0.055, 0.04])
        )
        solids.append(ellipsoid((sign * 0.23, y + 0.06, deep * 0.79), (0.11, 0.08, 0.07)))
    if rng.random() < 0.6:
        solids.append(ellipsoid((0, y + 0.3, -0.12), (wide * 1.08, 0.75 * tall, deep * 0.98)))
    low, wide_low = 0.1, 0.4
    if rng.random() < 0.5:
        solids.append(ellipsoid((0, 0.12, -0.1), (1.0, 0.45, 0.42), exponent=0.8))
        low, wide_low = -0.33, 0.7
    top = max(s.vertices[:, 1].max() for s in solids)
    return finish(
        solids,
        head_top=(0, top, -0.06),
        head_radius=wide,
        forehead=(0, y + 0.5 * wide, deep * 0.9),
        horn_direction=(0, 0.7, 0.7),
        back=(0, 0.45, -0.45),
        back_half_width=0.35,
        reach=0.9,
        side=(wide, y, 0),
        side_height=tall,
        bottom=low,
        foot_x=wide_low,
        foot_z=0.6,
        upright=True,
        foot_centre_z=0.0,
    )
