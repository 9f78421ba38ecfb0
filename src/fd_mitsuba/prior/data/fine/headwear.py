"""Parts on top of the head: hats, crowns, and what stands or floats there."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import jitter
from fd_mitsuba.prior.data.fine.shapes import curve, frame_towards, strip, torus, turned, unit
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import Solid, ellipsoid, join, lathe, rotation, sweep, transform

Rng = np.random.Generator
Zones = dict[str, Solid]
"""A part as closed solids by what they are made of."""


def placed(zones: Zones, turn: np.ndarray | None, shift: np.ndarray) -> Zones:
    return {name: transform(solid, turn, shift) for name, solid in zones.items()}


def around(count: int, radius: float, height: float, start: float = 0.0) -> np.ndarray:
    """Points (count, 3) on a circle about y, the first towards +z."""
    angle = start + np.arange(count) * (2 * np.pi / count)
    return np.stack([radius * np.sin(angle), np.full(count, height), radius * np.cos(angle)], 1)


def crown(surface: Surface, rng: Rng) -> Zones:
    """A band with raised edges, six separate pointed prongs with a ball on each, and stones between them."""
    size = surface.size
    radius, tall = jitter(rng, 0.86, 0.08) * size, jitter(rng, 0.5) * size
    prong = jitter(rng, 0.95) * tall
    wall = 0.09 * size
    band = turned(
        [
            (radius - wall, 0),
            (radius + wall, 0),
            (radius + wall, 0.18 * tall),
            (radius + 0.35 * wall, 0.24 * tall),
            (radius + 0.45 * wall, 0.8 * tall),
            (radius + 1.15 * wall, 0.86 * tall),
            (radius + 1.15 * wall, tall),
            (radius - 0.8 * wall, tall),
            (radius - wall, 0.02 * tall),
        ]
    )
    prongs, stones = [], []
    start = rng.uniform(0, 0.3)
    for out in unit(around(6, 1.0, 0.0, start)):
        foot = out * (radius + 0.2 * wall) + (0, 0.75 * tall, 0)
        tip = foot + out * 0.16 * size + (0, 0.25 * tall + prong, 0)
        share = np.linspace(0, 1, 4)
        tangent = np.cross((0, 1.0, 0), out)
        prongs.append(strip(foot + share[:, None] * (tip - foot), tangent, 0.34 * size * (1 - 0.85 * share), wall))
        prongs.append(ellipsoid(tip, (0.11 * size,) * 3))
    for out in unit(around(6, 1.0, 0.0, start + np.pi / 6)):
        stones.append(
            ellipsoid(
                out * (radius + 0.6 * wall) + (0, 0.52 * tall, 0),
                np.array([0.13, 0.16, 0.1]) * size,
                frame_towards((0, 1, 0), out),
            )
        )
    seat = surface.seat(radius) - np.array([0, 0.08 * size, 0])
    tilt = rotation(rng.uniform(-5, 5), 0, rng.uniform(-5, 5))
    return placed({"band": join([band, *prongs]), "stones": join(stones)}, tilt, seat)


def _brim(inner: float, outer: float, thick: float, droop: float) -> Solid:
    """A flat ring; `droop` is how much lower (or, negative, higher) its outer edge lies."""
    middle = (inner + outer) / 2
    return lathe(
        [
            (inner * 0.9, -thick),
            (middle, -thick - 0.25 * droop),
            (outer - thick, -thick - droop),
            (outer, -droop),
            (outer - thick, thick - droop),
            (middle, thick - 0.25 * droop),
            (inner * 0.9, thick),
            (inner * 0.88, -thick * 0.9),
        ],
        segments=36,
    )


def pointed_hat(surface: Surface, rng: Rng) -> Zones:
    """A tall cone whose tip bends, a wide thin brim, and a band where they meet."""
    size = surface.size
    radius, tall = jitter(rng, 0.92, 0.06) * size, jitter(rng, 2.5) * size
    outer, thick = jitter(rng, 1.8, 0.1) * size, 0.07 * size
    bend, aside = rng.uniform(-0.1, 0.4) * size, rng.uniform(-0.25, 0.25) * size
    spine = curve(
        [(0, -0.02, 0), (0, 0.45 * tall, 0), (0.25 * aside, 0.8 * tall, -0.25 * bend), (aside, tall, -bend)], 12
    )
    share = np.linspace(0, 1, 12)
    girth = radius * np.interp(share, [0, 0.12, 0.5, 0.85, 1], [1.0, 0.86, 0.46, 0.14, 0.04])
    path = unit(np.gradient(spine, axis=0))
    across = unit(np.array([1.0, 0, 0]) - (path @ [1.0, 0, 0])[:, None] * path)
    over = np.cross(path, across)
    body = sweep(spine, across * girth[:, None], over * girth[:, None], 24)
    brim = _brim(radius, outer, thick, rng.uniform(0.0, 0.12) * size)
    band = torus((0, 0.17 * size, 0), radius * 0.95, 0.13 * size, flatten=0.7)
    seat = surface.seat(radius) + np.array([0, 0.02 * size, 0])
    tilt = rotation(rng.uniform(-6, 6), 0, rng.uniform(-6, 6))
    return placed({"hat": join([body, brim]), "band": band}, tilt, seat)


def top_hat(surface: Surface, rng: Rng) -> Zones:
    """A tall cylinder, wider at the flat top, a brim with curled sides, and a ribbon."""
    size = surface.size
    radius, tall = jitter(rng, 0.88, 0.06) * size, jitter(rng, 1.75) * size
    outer = jitter(rng, 1.55, 0.08) * size
    body = turned(
        [
            (0.02, 0),
            (radius, 0),
            (radius * 0.94, 0.35 * tall),
            (radius * 1.0, 0.8 * tall),
            (radius * 1.1, tall),
            (0.02, tall),
        ]
    )
    brim = _brim(radius, outer, 0.075 * size, -0.05 * size)
    curl = brim.vertices.copy()
    curl[:, 1] += 0.16 * size * np.clip((np.abs(curl[:, 0]) / outer - 0.6) / 0.4, 0, None) ** 2
    ribbon = lathe(
        [
            (radius * 0.9, 0.1 * tall),
            (radius * 1.09, 0.1 * tall),
            (radius * 1.06, 0.33 * tall),
            (radius * 0.9, 0.33 * tall),
            (radius * 0.88, 0.11 * tall),
        ],
        segments=32,
    )
    seat = surface.seat(radius) + np.array([0, 0.02 * size, 0])
    tilt = rotation(rng.uniform(-6, 6), 0, rng.uniform(-6, 6))
    return placed({"hat": join([body, Solid(curl, brim.faces)]), "ribbon": ribbon}, tilt, seat)


def hat(surface: Surface, rng: Rng) -> Zones:
    """A round crown, a wide drooping brim, and a ribbon: a sun hat, a bowler, a cowboy's."""
    size = surface.size
    radius, tall = jitter(rng, 0.95, 0.06) * size, jitter(rng, 0.95) * size
    outer = jitter(rng, 1.85, 0.12) * size
    body = lathe(
        [
            (radius, -0.02),
            (radius * 1.01, 0.45 * tall),
            (radius * 0.92, 0.75 * tall),
            (radius * 0.66, 0.95 * tall),
            (radius * 0.3, tall * rng.uniform(0.92, 1.03)),
            (0.01, tall * 0.98),
        ],
        segments=32,
    )
    brim = _brim(radius, outer, 0.07 * size, rng.uniform(-0.12, 0.2) * size)
    ribbon = torus((0, 0.2 * size, 0), radius * 0.97, 0.15 * size, flatten=0.7)
    seat = surface.seat(radius) + np.array([0, 0.01 * size, 0])
    tilt = rotation(rng.uniform(-6, 6), 0, rng.uniform(-6, 6))
    return placed({"hat": join([body, brim]), "ribbon": ribbon}, tilt, seat)


def mushroom_cap(surface: Surface, rng: Rng) -> Zones:
    """A broad dome with raised round spots and a rim that turns under."""
    size = surface.size
    radius, tall = jitter(rng, 1.6, 0.1) * size, jitter(rng, 1.1) * size
    profile = [
        (0.4 * radius, 0.1 * tall),
        (0.75 * radius, 0.0),
        (0.95 * radius, -0.04 * tall),
        (radius, 0.07 * tall),
        (0.96 * radius, 0.3 * tall),
        (0.8 * radius, 0.62 * tall),
        (0.5 * radius, 0.88 * tall),
        (0.2 * radius, 0.99 * tall),
        (0.01, tall),
    ]
    cap = lathe(profile, segments=36)
    outline = np.array(profile[3:])
    spots = []
    for height, count, share in ((0.3, 7, 0.0), (0.68, 5, 0.4), (0.99, 1, 0.0)):
        wide = float(np.interp(height * tall, outline[:, 1], outline[:, 0])) if height < 0.95 else 0.0
        for at in around(count, wide * 0.97, height * tall, share + rng.uniform(0, 0.5)):
            away = unit(at * np.array([1 / radius**2, 1 / tall**2, 1 / radius**2]))
            half = jitter(rng, 0.2, 0.25) * radius
            spots.append(ellipsoid(at, (half, 0.06 * size, half), frame_towards(away, (1, 0.1, 0))))
    seat = surface.seat(0.7 * size)
    return placed({"cap": cap, "spots": join(spots)}, rotation(rng.uniform(-6, 6), 0, rng.uniform(-6, 6)), seat)
