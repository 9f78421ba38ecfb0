"""Parts that are put on a body: handles, skateboards, flowers, butterflies."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, head_size, jitter
from fd_mitsuba.prior.data.primitives import Array, Solid, box, ellipsoid, join, mirror_x, rotation, sweep, tube

Rng = np.random.Generator


def handle(body: Body, rng: Rng) -> Solid:
    """A round loop on the +x side."""
    tall, out = jitter(rng, 0.42) * body.side_height + 0.08, jitter(rng, 0.4) * body.side_height + 0.1
    radius = 0.05 + 0.05 * body.side_height
    angle = np.linspace(-np.pi / 2, np.pi / 2, 11)
    loop = np.stack(
        [body.side[0] - 0.06 + out * np.cos(angle), body.side[1] + tall * np.sin(angle), np.zeros_like(angle)], 1
    )
    return tube(loop, np.full(11, radius))


def board(centre: Array, path: Array, width: Array, thick: float, segments: int, exponent: float) -> Solid:
    """A flat bar about `centre` along a path (n, 2) of y and z, as wide as (n,) half-widths to either side."""
    zero = np.zeros(len(path))
    return sweep(
        centre + np.column_stack([zero, path]),
        np.stack([width, zero, zero], 1),
        np.stack([zero, zero + thick, zero], 1),
        segments,
        exponent,
    )


def skateboard(body: Body, rng: Rng) -> Solid:
    """A board with raised ends on four wheels, under the feet."""
    half_x, half_z = max(body.foot_x * 1.1, 0.22), max(body.foot_z * jitter(rng, 1.3), 0.55)
    thick, wheel = 0.045, 0.1
    z = np.linspace(-1, 1, 11) * half_z
    rise = 0.16 * np.clip(np.abs(z) / half_z - 0.72, 0, None) / 0.28
    width = half_x * np.sqrt(np.clip(1.04 - (np.abs(z) / half_z) ** 6, 0.02, None))
    centre = np.array([0, body.bottom - thick * 0.6, body.foot_centre_z])
    deck = board(centre, np.stack([rise, z], 1), width, thick, 14, 0.6)
    wheels = [
        ellipsoid(
            centre + (sx * half_x * 0.75, -thick - wheel * 0.75, sz * half_z * 0.6), (0.06, wheel, wheel), exponent=0.6
        )
        for sx in (1, -1)
        for sz in (1, -1)
    ]
    axles = [box(centre + (0, -thick - wheel * 0.5, sz * half_z * 0.6), (half_x * 0.75, 0.03, 0.04)) for sz in (1, -1)]
    return join([deck, *wheels, *axles])


def flower(body: Body, rng: Rng) -> Solid:
    """A stem with a big daisy on top of the head, turned towards the front and up."""
    size = head_size(body)
    stem, petal = jitter(rng, 1.0) * size, jitter(rng, 0.62) * size
    foot = body.head_top - np.array([0, 0.2 * size, 0])
    heart = foot + np.array([0, 0.2 * size + stem, 0.05 * size])
    tilt = rotation(degrees_x=rng.uniform(48, 62))
    petals = []
    for angle in np.arange(7) * 2 * np.pi / 7:
        turn = tilt @ rotation(degrees_y=np.rad2deg(angle))
        petals.append(
            ellipsoid(heart + turn @ np.array([0, 0, 0.95 * petal]), (0.36 * petal, 0.12 * petal, 0.62 * petal), turn)
        )
    centre = ellipsoid(heart, (0.45 * petal, 0.24 * petal, 0.45 * petal), tilt)
    return join([tube([foot, heart], [0.11 * size, 0.1 * size]), centre, *petals])


def butterfly(body: Body, rng: Rng) -> Solid:
    """A butterfly that sits on top of the head with four broad wings half open."""
    size = jitter(rng, 1.15) * head_size(body)
    lift = np.deg2rad(rng.uniform(32, 44))
    at = body.head_top + np.array([0, 0.12 * size, 0])
    trunk = tube([at + (0, 0, 0.55 * size), at + (0, 0, -0.6 * size)], [0.13 * size, 0.09 * size])
    aside, over = np.array([np.cos(lift), np.sin(lift), 0]), np.array([-np.sin(lift), np.cos(lift), 0])
    turn = np.stack([aside, over, np.array([0, 0, 1.0])], 1)
    wings = [
        ellipsoid(at + aside * 0.68 * size + (0, 0, 0.42 * size), (0.68 * size, 0.06 * size, 0.46 * size), turn),
        ellipsoid(at + aside * 0.52 * size - (0, 0, 0.38 * size), (0.5 * size, 0.06 * size, 0.38 * size), turn),
    ]
    right = join(wings)
    feelers = tube([at + (0.03 * size, 0, 0.5 * size), at + (0.3 * size, 0.4 * size, 0.85 * size)], [0.045 * size] * 2)
    return join([trunk, right, mirror_x(right), feelers, mirror_x(feelers)])
