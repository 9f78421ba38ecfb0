"""Bodies that people make, and heaps of simple solids that have no name."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, finish, jitter
from fd_mitsuba.prior.data.fine.shapes import disc, turned
from fd_mitsuba.prior.data.primitives import Solid, box, ellipsoid, join, mirror_x, rotation, tube

Rng = np.random.Generator


def chair(rng: Rng) -> Body:
    wide, deep, leg, back = jitter(rng, 0.5), jitter(rng, 0.5), jitter(rng, 0.55), jitter(rng, 0.75)
    thick, seat = jitter(rng, 0.07, 0.3), jitter(rng, 0.06, 0.3)
    solids = [box((0, leg + seat, 0), (wide, seat, deep))]
    for x in (wide - thick, thick - wide):
        solids.append(tube([(x, thick, deep - thick), (x, leg, deep - thick)], [thick] * 2))
        solids.append(tube([(x, thick, thick - deep), (x, leg + back, thick - deep)], [thick] * 2))
    top = leg + back
    if rng.random() < 0.5:
        solids.append(box((0, leg + 0.6 * back, thick - deep), (wide, 0.38 * back, 0.8 * thick)))
    else:
        bars = rng.integers(2, 5)
        solids += [box((0, leg + back * (k + 1) / bars, thick - deep), (wide, 0.09, 0.7 * thick)) for k in range(bars)]
    return finish(
        solids,
        head_top=(0, top + 0.06, thick - deep),
        head_radius=0.34,
        forehead=(0, top - 0.08, 2 * thick - deep),
        horn_direction=(0, 0.8, 0.6),
        back=(0, leg + 0.65 * back, -deep),
        back_half_width=0.6 * wide,
        reach=0.5 * (top + wide),
        side=(wide, leg + seat, 0),
        side_height=0.9 * leg,
        bottom=0.0,
        foot_x=wide,
        foot_z=deep,
        upright=True,
        foot_centre_z=0.0,
    )


def car(rng: Rng) -> Body:
    long, wide, tall, cabin = jitter(rng, 1.0), jitter(rng, 0.46), jitter(rng, 0.24), jitter(rng, 0.24)
    wheel = jitter(rng, 0.24)
    deck = wheel * 0.9 + tall
    at = rng.uniform(-0.25, 0.05) * long
    solids = [
        ellipsoid((0, deck, 0), (wide, tall, long), exponent=0.4),
        ellipsoid((0, deck + tall, at), (0.86 * wide, cabin * 1.5, rng.uniform(0.42, 0.6) * long), exponent=0.55),
    ]
    for z in (0.62 * long, -0.62 * long):
        solids += [disc((x, wheel, z), wheel, 0.11) for x in (0.92 * wide, -0.92 * wide)]
    for x in (0.6 * wide, -0.6 * wide):
        solids.append(ellipsoid((x, deck + 0.15 * tall, 0.96 * long), (0.12, 0.12, 0.08)))
    roof = deck + tall + 1.45 * cabin
    return finish(
        solids,
        head_top=(0, roof, at),
        head_radius=0.36,
        forehead=(0, deck + 0.95 * tall, 0.6 * long),
        horn_direction=(0, 0.8, 0.6),
        back=(0, roof, at - 0.1),
        back_half_width=0.6 * wide,
        reach=0.8 * long,
        side=(wide, deck, 0),
        side_height=2 * tall + cabin,
        bottom=0.0,
        foot_x=wide,
        foot_z=0.8 * long,
        foot_centre_z=0.0,
    )


def shoe(rng: Rng) -> Body:
    long, wide, tall = jitter(rng, 1.0), jitter(rng, 0.36), jitter(rng, 0.55, 0.25)
    solids = [
        ellipsoid((0, 0.09, 0), (wide, 0.1, long), exponent=0.55),
        ellipsoid((0, 0.26, 0.45 * long), (0.9 * wide, 0.26, 0.52 * long)),
        ellipsoid((0, 0.3, -0.3 * long), (0.85 * wide, 0.3, 0.65 * long)),
        tube([(0, 0.25, -0.45 * long), (0, tall, -0.5 * long)], [0.85 * wide, 0.8 * wide]),
    ]
    if rng.random() < 0.4:
        solids.append(box((0, 0.0, -0.7 * long), (0.8 * wide, 0.14, 0.24 * long)))
    top = tall + 0.4 * wide
    return finish(
        solids,
        head_top=(0, top, -0.5 * long),
        head_radius=0.8 * wide,
        forehead=(0, 0.5, 0.35 * long),
        horn_direction=(0, 0.8, 0.6),
        back=(0, 0.6 * top, -1.0 * long),
        back_half_width=0.5 * wide,
        reach=0.7 * long,
        side=(0.9 * wide, 0.35, 0),
        side_height=0.8 * top,
        bottom=0.0,
        foot_x=wide,
        foot_z=0.8 * long,
        foot_centre_z=0.0,
    )


def house(rng: Rng) -> Body:
    wide, deep, tall, roof = jitter(rng, 0.75), jitter(rng, 0.75), jitter(rng, 0.55), jitter(rng, 0.6)
    over = 1.15
    profile = np.array([(-over * wide, 0), (over * wide, 0), (0, roof)])
    rings = np.stack([np.concatenate([profile, np.full((3, 1), z)], 1) for z in (over * deep, -over * deep)])
    rings[..., 1] += 2 * tall
    faces = np.array([(0, 1, 2), (5, 4, 3), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)])
    gable = _flat_shaded(Solid(rings.reshape(-1, 3), faces))
    solids = [
        _flat_shaded(_cuboid((0, tall, 0), (wide, tall, deep))),
        gable,
        _flat_shaded(_cuboid((0, 0.5 * tall, deep), (0.18 * wide, 0.5 * tall, 0.05))),
    ]
    for x in (0.55 * wide, -0.55 * wide):
        solids.append(_flat_shaded(_cuboid((x, 1.2 * tall, deep), (0.16 * wide, 0.25 * tall, 0.04))))
    if rng.random() < 0.6:
        solids.append(
            _flat_shaded(_cuboid((0.5 * wide, 2 * tall + 0.65 * roof, -0.3 * deep), (0.11, 0.4 * roof, 0.11)))
        )
    return finish(
        solids,
        head_top=(0, 2 * tall + roof, 0),
        head_radius=0.32,
        forehead=(0, 2 * tall + 0.4 * roof, over * deep),
        horn_direction=(0, 0.6, 0.8),
        back=(0, 1.4 * tall, -deep),
        back_half_width=0.5 * wide,
        reach=tall + 0.6 * roof,
        side=(wide, tall, 0),
        side_height=1.4 * tall,
        bottom=0.0,
        foot_x=wide,
        foot_z=deep,
        upright=True,
        foot_centre_z=0.0,
    )


def heap(rng: Rng) -> Body:
    """A few simple solids grown together: a body without a name, so that parts need not know what they are put on."""
    solids: list[Solid] = []
    at = np.zeros(3)
    for _ in range(rng.integers(2, 6)):
        half = rng.uniform(0.25, 0.75, 3)
        turn = rotation(*rng.uniform(-40, 40, 3))
        kind = rng.integers(3)
        if kind == 0:
            solid = ellipsoid(at, half, turn, exponent=rng.choice([1.0, 0.6, 0.3]))
        elif kind == 1:
            solid = tube([at - turn @ (0, half[1], 0), at + turn @ (0, half[1], 0)], half[[0, 2]] * 0.7)
        else:
            solid = turned([(0.02, -half[1]), (half[0], -half[1]), (half[2], half[1]), (0.02, half[1])])
            solid = Solid(solid.vertices @ turn.T + at, solid.faces)
        mirrored = rng.random() < 0.5
        solids += [solid, mirror_x(solid)] if mirrored else [solid]
        at = at + rng.normal(size=3) * (0.3, 0.45, 0.35)
    points = join(solids).vertices
    low, high = points.min(0), points.max(0)
    column = points[np.linalg.norm(points[:, ::2], axis=1) < 0.35]
    top = column[column[:, 1].argmax()] if len(column) else points[points[:, 1].argmax()]
    middle, extent = (low + high) / 2, high - low
    upright = bool(rng.random() < 0.6)
    return finish(
        solids,
        head_top=(0, top[1], 0),
        head_radius=0.16 * extent.max(),
        forehead=(0, top[1] - 0.12 * extent[1], 0.2),
        horn_direction=(0, 0.8, 0.6),
        upright=upright,
        back=(0, middle[1] + 0.15 * extent[1], low[2] + 0.2 * extent[2]) if upright else (0, top[1] - 0.05, middle[2]),
        back_half_width=0.2 * extent[0],
        reach=0.4 * extent.max(),
        side=(0.85 * high[0], middle[1], 0),
        side_height=0.6 * extent[1],
        bottom=low[1],
        foot_x=0.3 * extent[0],
        foot_z=0.35 * extent[2],
        foot_centre_z=middle[2],
    )


def _cuboid(centre: tuple, half: tuple) -> Solid:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(half)
    faces = np.array(
        [
            (0, 1, 3),
            (0, 3, 2),
            (4, 6, 7),
            (4, 7, 5),
            (0, 4, 5),
            (0, 5, 1),
            (2, 3, 7),
            (2, 7, 6),
            (0, 2, 6),
            (0, 6, 4),
            (1, 5, 7),
            (1, 7, 3),
        ]
    )
    return Solid(corners + np.array(centre), faces)


def _flat_shaded(solid: Solid) -> Solid:
    """The solid with its faces divided and their corners apart, so that vertex normals are the faces' own."""
    vertices = solid.vertices[solid.faces].reshape(-1, 3)
    return Solid(vertices, np.arange(len(vertices)).reshape(-1, 3))
