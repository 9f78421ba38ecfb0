"""Procedural animals on all fours, birds, turtles and fish; sizes are jittered by seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.data.body import Body, finish, jitter
from fd_mitsuba.prior.data.primitives import ellipsoid, mirror_x, rotation, tube


def quadruped(
    rng: np.random.Generator,
    *,
    leg: float,
    length: float,
    girth: float,
    neck: float,
    neck_tilt: float,
    head: float,
    muzzle: float,
    ear: float,
    tail: float,
    horns: float = 0.0,
) -> Body:
    """Barrel, four legs, neck, head with muzzle and ears, tail; lengths are shares of the barrel's half length."""
    leg, length, girth = jitter(rng, leg), jitter(rng, length), jitter(rng, girth)
    neck, head, muzzle, ear, tail = (jitter(rng, v) for v in (neck, head, muzzle, ear, tail))
    tilt = np.deg2rad(neck_tilt + rng.uniform(-8, 8))
    barrel_y = leg + girth * 0.8
    solids = [
        tube(
            [(0, barrel_y, -length), (0, barrel_y + 0.06 * girth, 0), (0, barrel_y + 0.1 * girth, length)],
            [girth * 0.95, girth * 0.9, girth],
        )
    ]
    thick = girth * rng.uniform(0.26, 0.36)
    spread = girth * 0.6
    for z in (-length * 0.95, length * 0.95):
        side = tube(
            [(spread, barrel_y, z), (spread, leg * 0.5, z + 0.03 * length), (spread, thick * 0.6, z)],
            [thick * 1.3, thick * 0.85, thick * 0.8],
        )
        solids += [side, mirror_x(side)]
    neck_base = np.array([0, barrel_y + 0.35 * girth, length * 1.05])
    neck_end = neck_base + neck * np.array([0, np.sin(tilt), np.cos(tilt)])
    solids.append(tube([neck_base, (neck_base + neck_end) / 2, neck_end], [girth * 0.66, girth * 0.5, head * 0.72]))
    droop = rotation(degrees_x=rng.uniform(10, 28))
    solids.append(ellipsoid(neck_end, (head * 0.8, head * 0.85, head), droop))
    forward = droop @ np.array([0, 0, 1.0])
    nose = neck_end + forward * (head * 0.7 + muzzle)
    solids.append(tube([neck_end + forward * head * 0.4, nose], [head * 0.62, head * 0.44]))
    for sign in (1, -1):
        root = neck_end + np.array([sign * head * 0.5, head * 0.6, -head * 0.1])
        solids.append(
            tube([root, root + np.array([sign * 0.25, 1, -0.1]) * ear], [head * 0.22, head * 0.07], flatten=0.6)
        )
    tail_base = np.array([0, barrel_y + girth * 0.6, -length - girth * 0.8])
    solids.append(
        tube(
            [tail_base, tail_base + (0, -tail * 0.4, -tail * 0.5), tail_base + (0, -tail, -tail * 0.6)],
            [girth * 0.18, girth * 0.16, girth * 0.1],
        )
    )
    top = neck_end + np.array([0, head * 0.82, -head * 0.1])
    return finish(
        solids,
        head_top=top,
        head_radius=head * 0.8,
        forehead=neck_end + np.array([0, head * 0.72, head * 0.42]),
        horn_direction=(0, 0.85, 0.5),
        back=(0, barrel_y + girth * 0.75, length * 0.35),
        back_half_width=girth * 0.55,
        reach=length + girth,
        side=(girth * 0.95, barrel_y, 0),
        side_height=girth * 1.5,
        bottom=0.0,
        foot_x=spread + thick,
        foot_z=length * 0.95 + thick,
        foot_centre_z=0.0,
    )


def species(**shape) -> Callable[[np.random.Generator], Body]:
    return lambda rng: quadruped(rng, **shape)


def bird(rng: np.random.Generator) -> Body:
    body, head, neck = jitter(rng, 0.6), jitter(rng, 0.36), jitter(rng, 0.45, 0.4)
    head_at = np.array([0, body * 1.2 + neck, body * 0.75])
    beak = jitter(rng, 0.3, 0.3)
    solids = [
        ellipsoid((0, body, 0), (body * 0.8, body * 0.75, body * 1.2), rotation(-12)),
        tube([np.array([0, body * 1.2, body * 0.6]), head_at], [body * 0.45, head * 0.7]),
        ellipsoid(head_at, (head,) * 3),
        tube(
            [head_at + (0, -0.03, head * 0.8), head_at + (0, -0.06, head * 0.9 + beak)],
            [head * 0.34, head * 0.2],
            flatten=0.5,
        ),
        tube([(0, body * 1.15, -body * 0.9), (0, body * 1.6, -body * 1.6)], [body * 0.3, body * 0.12]),
    ]
    for x in (0.25, -0.25):
        solids.append(tube([(x, body * 0.4, 0.05), (x, 0.04, 0.1), (x, 0.04, 0.3)], [0.08, 0.08, 0.08]))
    return finish(
        solids,
        head_top=head_at + (0, head * 0.9, 0),
        head_radius=head * 0.85,
        forehead=head_at + (0, head * 0.7, head * 0.6),
        horn_direction=(0, 0.8, 0.6),
        back=(0, body * 1.5, -body * 0.1),
        back_half_width=body * 0.5,
        reach=body * 1.7,
        side=(body * 0.75, body, 0),
        side_height=body,
        bottom=0.0,
        foot_x=0.33,
        foot_z=body * 0.8,
        foot_centre_z=0.1,
    )


def turtle(rng: np.random.Generator) -> Body:
    shell, dome, head = jitter(rng, 0.8), jitter(rng, 0.42), jitter(rng, 0.24)
    head_at = np.array([0, 0.5, shell * 1.35])
    solids = [
        ellipsoid((0, 0.38, 0), (shell * 0.85, dome, shell)),
        ellipsoid((0, 0.28, 0), (shell * 0.9, 0.12, shell * 1.04)),
        tube([np.array([0, 0.3, shell * 0.8]), head_at], [head * 0.6, head * 0.7]),
        ellipsoid(head_at, (head, head * 0.9, head * 1.2)),
    ]
    for z in (-0.6, 0.65):
        leg = tube([(shell * 0.55, 0.28, z * shell), (shell * 0.9, 0.1, z * shell * 1.15)], [0.15, 0.13])
        solids += [leg, mirror_x(leg)]
    return finish(
        solids,
        head_top=head_at + (0, head * 0.8, 0),
        head_radius=head * 0.85,
        forehead=head_at + (0, head * 0.6, head * 0.7),
        horn_direction=(0, 0.8, 0.6),
        back=(0, 0.36 + dome * 0.9, 0),
        back_half_width=shell * 0.35,
        reach=shell * 1.2,
        side=(shell * 0.85, 0.36, 0),
        side_height=dome * 1.4,
        bottom=0.0,
        foot_x=shell * 0.8,
        foot_z=shell * 0.9,
        foot_centre_z=0.0,
    )


def fish(rng: np.random.Generator) -> Body:
    long, tall, wide = jitter(rng, 1.0), jitter(rng, 0.5, 0.2), jitter(rng, 0.3, 0.2)
    fin = jitter(rng, 0.35)
    solids = [
        ellipsoid((0, 0, 0), (wide, tall, long)),
        tube([(0, 0, -long * 0.9), (0, fin, -long - fin)], [tall * 0.2, tall * 0.16], flatten=0.5),
        tube([(0, 0, -long * 0.9), (0, -fin, -long - fin)], [tall * 0.2, tall * 0.16], flatten=0.5),
    ]
    for sign in (1, -1):
        solids.append(ellipsoid((sign * wide * 0.72, tall * 0.25, long * 0.62), (0.06,) * 3))
    return finish(
        solids,
        head_top=(0, tall * 0.82, long * 0.45),
        head_radius=wide * 0.75,
        forehead=(0, tall * 0.62, long * 0.68),
        horn_direction=(0, 0.7, 0.7),
        back=(0, tall * 0.7, 0),
        back_half_width=wide * 0.6,
        reach=long * 0.8,
        side=(wide * 0.97, 0, 0),
        side_height=tall,
        bottom=-tall,
        foot_x=wide,
        foot_z=long * 0.7,
        foot_centre_z=0.0,
    )
