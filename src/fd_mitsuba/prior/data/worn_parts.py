"""Parts that are worn: hats, crowns, glasses, capes, backpacks."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, head_size, jitter
from fd_mitsuba.prior.data.primitives import Solid, box, join, lathe, mirror_x, rotation, sweep, transform, tube

Rng = np.random.Generator


def _on_head(body: Body, profile: list[tuple[float, float]], rng: Rng) -> Solid:
    size = head_size(body)
    hat = lathe([(r * size, y * size) for r, y in profile])
    sink = 0.22 * size
    return transform(hat, rotation(rng.uniform(-6, 6), 0, rng.uniform(-6, 6)), body.head_top - np.array([0, sink, 0]))


def pointed_hat(body: Body, rng: Rng) -> Solid:
    """A cone with a wide flat brim."""
    tall, brim = jitter(rng, 2.5), jitter(rng, 1.6, 0.08)
    return _on_head(
        body,
        [(brim * 0.96, 0), (brim, 0.08), (brim * 0.96, 0.16), (0.92, 0.22), (0.5, 0.1 + tall * 0.5), (0.04, tall)],
        rng,
    )


def top_hat(body: Body, rng: Rng) -> Solid:
    """A tall flat-topped cylinder with a brim."""
    tall, brim = jitter(rng, 1.9), jitter(rng, 1.5, 0.08)
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
    size = head_size(body)
    tall = jitter(rng, 0.55) * size
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


def glasses(body: Body, rng: Rng) -> Solid:
    """Two thick round rims before the eyes, a bridge between them and two arms to the ears."""
    size, eyes = head_size(body), body.eyes()
    ring, thick = jitter(rng, 0.44) * size, jitter(rng, 0.1) * size
    z = eyes[:, 2].max() + 0.6 * thick
    across = max(0.5 * (eyes[0, 0] - eyes[1, 0]), ring * 1.08)
    angle = np.linspace(0, 2 * np.pi, 15)
    rim = np.stack([across + ring * np.cos(angle), eyes[0, 1] + ring * np.sin(angle), np.full(15, z)], 1)
    arm = tube(
        [(across + ring, eyes[0, 1], z), (across + ring * 1.05, eyes[0, 1] + 0.1 * size, z - 1.6 * size)],
        [thick * 0.8] * 2,
    )
    bridge = tube(
        [(-across + ring, eyes[0, 1] + 0.2 * ring, z), (across - ring, eyes[0, 1] + 0.2 * ring, z)], [thick] * 2
    )
    right = join([tube(rim, np.full(15, thick)), arm])
    return join([right, mirror_x(right), bridge])


def cape(body: Body, rng: Rng) -> Solid:
    """A cloth over the back: it hangs from the shoulders and flares (upright), or lies over the back like a rug."""
    thick = 0.035
    if body.upright:
        top, low = body.back[1] + 0.35 * body.side_height, body.bottom + 0.1 * (body.back[1] - body.bottom)
        share = np.linspace(0, 1, 8)
        half = body.back_half_width * (1.5 + jitter(rng, 1.0) * share)
        behind = body.spine(8)[0][:, 2].min() - 0.03 - 0.28 * body.reach * share**1.5
        centres = np.stack([np.zeros(8), top + share * (low - top), behind], 1)
        across = np.stack([half, np.zeros(8), np.zeros(8)], 1)
        along = np.tile([0.0, 0.0, thick], (8, 1))
        return sweep(centres, across, along, 16, exponent=0.5)
    ridge, _ = body.spine(5)
    half_x, centre_y = body.side[0] * 1.12 + 0.04, body.side[1]
    top = ridge[:, 1].max() + 0.04
    angle = np.deg2rad(np.linspace(-88, 88, 13)) * jitter(rng, 1.0, 0.06)
    centre_z, half_z = ridge[:, 2].mean(), 0.5 * np.ptp(ridge[:, 2]) * 0.9
    radial = np.stack([np.sin(angle), np.cos(angle), np.zeros(13)], 1)
    centres = radial * [half_x, top - centre_y, 0] + [0, centre_y, centre_z]
    return sweep(centres, np.tile([0.0, 0.0, -half_z], (13, 1)), radial * thick, 16, exponent=0.5)


def backpack(body: Body, rng: Rng) -> Solid:
    """A rounded pack with a flap and a pocket on the back."""
    points, outward = body.spine(5)
    at = (points[2] + points[3] if body.upright else points[1] + points[2]) / 2
    away = outward[2]
    wide, tall = jitter(rng, 0.3) * max(body.reach, 0.55), jitter(rng, 0.36) * max(body.reach, 0.55)
    deep = 0.6 * wide
    if body.upright:
        turn, away = np.eye(3), np.array([0.0, 0.0, -1.0])
    else:
        turn = rotation(degrees_x=90)
    pack = box((0, 0, 0), (wide, tall, deep), turn)
    pocket = box((0, 0, 0), (wide * 0.7, tall * 0.45, deep * 0.45), turn)
    along = turn @ np.array([0, 1.0, 0])
    middle = at + away * deep * 0.85
    return join(
        [
            transform(pack, shift=middle),
            transform(pocket, shift=middle + away * deep * 1.1 - along * tall * 0.4),
            transform(box((0, 0, 0), (wide * 1.06, tall * 0.2, deep * 1.1), turn), shift=middle + along * tall * 0.85),
        ]
    )
