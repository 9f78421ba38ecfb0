"""Procedural parts, grown from a body's anchors with little jitter, so that one word means one shape."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.bodies import Body
from fd_mitsuba.prior.primitives import Solid, box, ellipsoid, join, lathe, mirror_x, rotation, sweep, transform, tube

Rng = np.random.Generator


def _jitter(rng: Rng, value: float, share: float = 0.1) -> float:
    return value * (1 + share * rng.uniform(-1, 1))


def _head_size(body: Body) -> float:
    """The half-width that head-worn parts are made for: neither a bead on a bird nor a lid on a mug."""
    return float(np.clip(body.head_radius, 0.15, 0.4))


def wings(body: Body, rng: Rng) -> Solid:
    """Two feathered wings, raised and swept back, broad at the wrist and pointed at the tip."""
    span, chord = _jitter(rng, 1.0) * body.reach, _jitter(rng, 0.5) * body.reach
    raise_deg, thick = rng.uniform(38, 50), 0.05 * body.reach + 0.012
    share = np.linspace(0, 1, 9)
    width = chord * np.interp(share, [0, 0.25, 0.55, 0.85, 1], [0.55, 0.95, 1.0, 0.6, 0.12]) / 2
    lift = np.deg2rad(raise_deg) * (1 - 0.35 * share)
    step = span * np.diff(share, prepend=0)
    x, y = np.cumsum(step * np.cos(lift)), np.cumsum(step * np.sin(lift))
    z = -0.28 * span * share**1.6 - (width - width[0]) * 0.6
    root = body.back + np.array([body.back_half_width * 0.6, -0.02, 0])
    centres = root + np.stack([x, y, z], 1)
    path = np.stack([np.cos(lift), np.sin(lift), np.zeros_like(lift)], 1)
    front = np.broadcast_to([0.0, 0.0, 1.0], path.shape)
    normal = np.cross(path, front)
    thickness = thick * (1 - 0.55 * share)[:, None]
    right = (
        sweep(centres, normal * thickness, front * width[:, None], 14)
        if np.linalg.det(np.stack([normal[0], front[0], path[0]])) > 0
        else sweep(centres, front * width[:, None], normal * thickness, 14)
    )
    return join([right, mirror_x(right)])


def horn(body: Body, rng: Rng) -> Solid:
    """One straight, slender horn on the forehead."""
    size = _head_size(body)
    length, radius = _jitter(rng, 2.2) * size, _jitter(rng, 0.27) * size
    tip = body.forehead + body.horn_direction * length
    return tube(
        [body.forehead - body.horn_direction * radius, (body.forehead + tip) / 2, tip], [radius, radius * 0.55, 0.012]
    )


def antlers(body: Body, rng: Rng) -> Solid:
    """Two branching antlers on top of the head."""
    size = _head_size(body)
    length, radius = _jitter(rng, 2.4) * size, _jitter(rng, 0.15) * size
    root = body.head_top + np.array([size * 0.4, -size * 0.2, 0])
    bend = root + length * np.array([0.42, 0.42, -0.12])
    tip = root + length * np.array([0.55, 1.0, 0.02])
    main = tube([root, bend, tip], [radius * 1.1, radius, radius * 0.6])
    middle = (bend + tip) / 2
    tines = [
        tube([bend, bend + length * np.array([0.02, 0.22, 0.34])], [radius, radius * 0.6]),
        tube([middle, middle + length * np.array([0.32, 0.24, 0.04])], [radius * 0.9, radius * 0.55]),
    ]
    right = join([main, *tines])
    return join([right, mirror_x(right)])


def _on_head(body: Body, profile: list[tuple[float, float]], rng: Rng) -> Solid:
    size = _head_size(body)
    hat = lathe([(r * size, y * size) for r, y in profile])
    sink = 0.22 * size
    return transform(hat, rotation(rng.uniform(-6, 6), 0, rng.uniform(-6, 6)), body.head_top - np.array([0, sink, 0]))


def pointed_hat(body: Body, rng: Rng) -> Solid:
    """A cone with a wide flat brim."""
    tall, brim = _jitter(rng, 2.5), _jitter(rng, 1.6, 0.08)
    return _on_head(
        body,
        [(brim * 0.96, 0), (brim, 0.08), (brim * 0.96, 0.16), (0.92, 0.22), (0.5, 0.1 + tall * 0.5), (0.04, tall)],
        rng,
    )


def top_hat(body: Body, rng: Rng) -> Solid:
    """A tall flat-topped cylinder with a brim."""
    tall, brim = _jitter(rng, 1.9), _jitter(rng, 1.5, 0.08)
    return _on_head(
        body,
        [
            (brim * 0.96, 0),
            (brim, 0.08),
            (brim * 0.96, 0.16),
            (0.88, 0.2),
            (0.86, tall * 0.6),
            (0.94, tall),
            (0.9, tall + 0.05),
        ],
        rng,
    )


def crown(body: Body, rng: Rng) -> Solid:
    """A flaring band with six pointed prongs."""
    size = _head_size(body)
    tall = _jitter(rng, 0.55) * size
    inner, outer = 0.86 * size, 1.02 * size
    band = lathe([(inner, 0), (outer, 0), (outer * 1.08, tall), (inner * 1.1, tall), (inner, 0.01)])
    prongs = []
    for angle in np.arange(6) * np.pi / 3 + rng.uniform(0, 0.2):
        around = np.array([np.sin(angle), 0, np.cos(angle)])
        foot = around * outer * 1.0 + np.array([0, tall * 0.9, 0])
        prongs.append(
            tube(
                [foot, foot + around * 0.14 * size + np.array([0, tall * 1.35, 0])],
                [0.26 * size, 0.05 * size],
                flatten=0.8,
            )
        )
    return transform(join([band, *prongs]), shift=body.head_top - np.array([0, 0.2 * size, 0]))


def handle(body: Body, rng: Rng) -> Solid:
    """A round loop on the +x side."""
    tall, out = _jitter(rng, 0.42) * body.side_height + 0.08, _jitter(rng, 0.4) * body.side_height + 0.1
    radius = 0.05 + 0.05 * body.side_height
    angle = np.linspace(-np.pi / 2, np.pi / 2, 11)
    loop = np.stack(
        [body.side[0] - 0.06 + out * np.cos(angle), body.side[1] + tall * np.sin(angle), np.zeros_like(angle)], 1
    )
    return tube(loop, np.full(11, radius))


def skateboard(body: Body, rng: Rng) -> Solid:
    """A board with raised ends on four wheels, under the feet."""
    half_x, half_z = max(body.foot_x * 1.1, 0.22), max(body.foot_z * _jitter(rng, 1.3), 0.55)
    thick, wheel = 0.045, 0.1
    z = np.linspace(-1, 1, 11) * half_z
    rise = 0.16 * np.clip(np.abs(z) / half_z - 0.72, 0, None) / 0.28
    width = half_x * np.sqrt(np.clip(1.04 - (np.abs(z) / half_z) ** 6, 0.02, None))
    zero = np.zeros_like(z)
    centre = np.array([0, body.bottom - thick * 0.6, body.foot_centre_z])
    deck = sweep(
        centre + np.stack([zero, rise, z], 1),
        np.stack([width, zero, zero], 1),
        np.stack([zero, zero + thick, zero], 1),
        14,
        exponent=0.6,
    )
    wheels = [
        ellipsoid(
            centre + (sx * half_x * 0.75, -thick - wheel * 0.75, sz * half_z * 0.6), (0.06, wheel, wheel), exponent=0.6
        )
        for sx in (1, -1)
        for sz in (1, -1)
    ]
    axles = [box(centre + (0, -thick - wheel * 0.5, sz * half_z * 0.6), (half_x * 0.75, 0.03, 0.04)) for sz in (1, -1)]
    return join([deck, *wheels, *axles])


PARTS: dict[str, Callable[[Body, Rng], Solid]] = {
    "wings": wings,
    "horn": horn,
    "antlers": antlers,
    "pointed hat": pointed_hat,
    "top hat": top_hat,
    "crown": crown,
    "handle": handle,
    "skateboard": skateboard,
}
"""Every part word of the vocabulary and its maker."""
