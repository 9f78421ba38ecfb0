"""Parts that stand or float on top of the head: halos, candles, propellers, ears, umbrellas, flowers, butterflies."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import jitter
from fd_mitsuba.prior.data.fine.headwear import Rng, Zones, around, placed
from fd_mitsuba.prior.data.fine.shapes import curve, sheet, strip, torus, turned, unit
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import ellipsoid, join, lathe, mirror_x, rotation, transform, tube


def halo(surface: Surface, rng: Rng) -> Zones:
    """A ring that floats above the head."""
    size = surface.size
    ring = torus((0, 0, 0), jitter(rng, 0.85) * size, 0.13 * size)
    at = surface.body.head_top + np.array([0, jitter(rng, 0.55) * size, 0])
    return placed({"ring": ring}, rotation(rng.uniform(-8, 8), 0, rng.uniform(-8, 8)), at)


def candle(surface: Surface, rng: Rng) -> Zones:
    """A thick candle with drips at its rim and a flame on a wick."""
    size = surface.size
    radius, tall = jitter(rng, 0.32) * size, jitter(rng, 1.5) * size
    stick = turned([(0.01, -0.15 * size), (radius, -0.15 * size), (radius, tall), (0.01, tall)])
    drips = []
    for at in around(5, radius * 0.98, 0.0, rng.uniform(0, 1)):
        low = tall * rng.uniform(0.55, 0.85)
        drips.append(tube([at + (0, tall, 0), at + (0, low, 0)], [0.07 * size, 0.085 * size]))
    wick = tube([(0, tall, 0), (0, tall + 0.14 * size, 0)], [0.04 * size] * 2)
    base = tall + 0.12 * size
    flame = lathe(
        [
            (0.01, base),
            (0.15 * size, base + 0.1 * size),
            (0.2 * size, base + 0.25 * size),
            (0.13 * size, base + 0.45 * size),
            (0.01, base + 0.72 * size),
        ],
        segments=16,
    )
    zones = {"wax": join([stick, *drips]), "wick": wick, "flame": flame}
    return placed(zones, None, surface.body.head_top)


def propeller(surface: Surface, rng: Rng) -> Zones:
    """A shaft on a small cap with a hub and three twisted blades."""
    size = surface.size
    length, tall = jitter(rng, 1.35) * size, jitter(rng, 0.75) * size
    cap = lathe(
        [
            (0.55 * size, -0.1 * size),
            (0.55 * size, 0.02),
            (0.42 * size, 0.2 * size),
            (0.15 * size, 0.32 * size),
            (0.01, 0.34 * size),
        ],
        segments=24,
    )
    shaft = tube([(0, 0, 0), (0, tall, 0)], [0.09 * size] * 2)
    hub = ellipsoid((0, tall, 0), (0.2 * size, 0.2 * size, 0.2 * size))
    blades = []
    share = np.linspace(0, 1, 6)
    start = rng.uniform(0, 2)
    for out in unit(around(3, 1.0, 0.0, start)):
        tangent = np.cross((0, 1.0, 0), out)
        twist = np.deg2rad(50 - 30 * share)[:, None]
        across = np.cos(twist) * tangent + np.sin(twist) * np.array([0, 1.0, 0])
        points = np.array([0, tall, 0]) + out * (0.1 * size + share[:, None] * length)
        wide = size * np.array([0.16, 0.26, 0.3, 0.3, 0.26, 0.12])
        blades.append(strip(points, across, wide, 0.06 * size))
    zones = {"cap": join([cap, shaft, hub]), "blades": join(blades)}
    return placed(zones, rotation(rng.uniform(-8, 8), 0, rng.uniform(-8, 8)), surface.body.head_top)


def ears(surface: Surface, rng: Rng) -> Zones:
    """Two long upright ears, hollow at the front."""
    size = surface.size
    length, wide = jitter(rng, 1.7) * size, jitter(rng, 0.34) * size
    root = np.array([0.45 * size, -0.3 * size, 0])
    lean = np.array([rng.uniform(0.12, 0.4), 1.0, -0.08])
    share = np.linspace(0, 1, 9)[:, None]
    points = root + share * length * lean + share**2 * np.array([0.12 * length, 0, -0.06 * length])
    half = wide * np.interp(share[:, 0], [0, 0.25, 0.6, 0.9, 1], [0.6, 0.85, 1.0, 0.6, 0.12])
    outer = strip(points, (1, 0, 0), half, 0.5 * half + 0.02 * size, 14)
    inner = strip(points[1:-1] + (0, 0, 0.09 * size), (1, 0, 0), 0.62 * half[1:-1], 0.5 * half[1:-1], 12)
    zones = {"ears": join([outer, mirror_x(outer)]), "inner": join([inner, mirror_x(inner)])}
    return placed(zones, None, surface.body.head_top)


def umbrella(surface: Surface, rng: Rng) -> Zones:
    """An open canopy of eight gores with scalloped edge and ribs, on a stick with a hooked end and a ferrule."""
    size = surface.size
    radius, rise = jitter(rng, 1.9, 0.1) * size, jitter(rng, 0.8) * size
    stick = jitter(rng, 1.7) * size
    around_count, rows = 41, 8
    angle = np.linspace(0, 2 * np.pi, around_count)
    share = np.linspace(0.04, 1, rows)[:, None]
    gore = np.abs(np.sin(4 * angle))[None]
    out = radius * np.sin(share * np.pi / 2) * (1 - 0.07 * share**3 * gore)
    height = stick + rise * np.cos(share * np.pi / 2) + 0.10 * rise * share**2 * gore
    grid = np.stack([out * np.sin(angle), height + 0 * angle, out * np.cos(angle)], -1)
    canopy = sheet(grid, 0.09 * size)
    ribs = [
        tube(
            np.stack(
                [
                    radius * np.sin(s) * np.sin(a),
                    stick + rise * np.cos(s) - 0.03 * size,
                    radius * np.sin(s) * np.cos(a),
                ],
                1,
            ),
            np.full(6, 0.045 * size),
            8,
        )
        for a in np.arange(8) * np.pi / 4
        for s in [np.linspace(0.1, np.pi / 2, 6)]
    ]
    pole = tube([(0, -0.1 * size, 0), (0, stick + rise + 0.25 * size, 0)], [0.075 * size, 0.06 * size])
    hook_angle = np.linspace(0, 1.1 * np.pi, 9)
    hook = np.stack(
        [0.0 * hook_angle, 0.12 * size - 0.2 * size * np.sin(hook_angle), 0.2 * size * (1 - np.cos(hook_angle))], 1
    )
    grip = tube(hook, np.full(9, 0.1 * size))
    tilt = rotation(rng.uniform(-14, 14), 0, rng.uniform(-14, 14))
    zones = {"canopy": join([canopy, *ribs]), "stick": pole, "grip": grip}
    return placed(zones, tilt, surface.body.head_top + np.array([0, 0.05 * size, 0]))


def flower(surface: Surface, rng: Rng) -> Zones:
    """A stem with two leaves and a daisy: a round heart and ten separate petals, turned to the front and up."""
    size = surface.size
    stem, petal = jitter(rng, 1.25) * size, jitter(rng, 0.62) * size
    sway = rng.uniform(-0.15, 0.15) * size
    line = curve([(0, -0.15 * size, 0), (0.5 * sway, 0.5 * stem, 0), (sway, stem, 0.12 * size)], 8)
    heart = line[-1]
    tilt = rotation(degrees_x=rng.uniform(42, 60))
    petals = []
    for angle in np.arange(10) * 36.0:
        turn = tilt @ rotation(degrees_y=angle)
        share = np.linspace(0, 1, 7)
        points = np.stack([0 * share, 0.16 * petal * np.sin(share * 2.2), petal * (0.3 + 1.15 * share)], 1)
        half = petal * np.array([0.12, 0.2, 0.27, 0.31, 0.3, 0.23, 0.08])
        petals.append(transform(strip(points, (1, 0, 0), half, 0.07 * petal + 0.01, 8), turn, heart))
    centre = ellipsoid(heart + tilt @ (0, 0.08 * petal, 0), (0.4 * petal, 0.24 * petal, 0.4 * petal), tilt)
    leaves = []
    for sign, at in ((1, 2), (-1, 4)):
        share = np.linspace(0, 1, 6)
        points = line[at] + np.stack(
            [sign * 0.75 * size * share, 0.42 * size * share - 0.35 * size * share**2, 0.1 * size * share], 1
        )
        half = size * np.array([0.06, 0.18, 0.24, 0.22, 0.14, 0.03])
        leaves.append(strip(points, (0, 0.25, 1.0), half, 0.045 * size, 8))
    green = join([tube(line, np.full(8, 0.085 * size)), *leaves])
    return placed({"stem": green, "heart": centre, "petals": join(petals)}, None, surface.body.head_top)


def butterfly(surface: Surface, rng: Rng) -> Zones:
    """A butterfly: a body in three pieces, feelers with knobs, four wings with veins and raised spots."""
    size = 1.45 * jitter(rng, 1.0) * surface.size
    lift = np.deg2rad(rng.uniform(24, 46))
    trunk = join(
        [
            ellipsoid((0, 0, 0.5 * size), (0.12 * size, 0.12 * size, 0.13 * size)),
            ellipsoid((0, 0, 0.22 * size), (0.15 * size, 0.15 * size, 0.24 * size)),
            ellipsoid((0, -0.02 * size, -0.35 * size), (0.11 * size, 0.11 * size, 0.42 * size)),
        ]
    )
    outlines = {
        "fore": ((0.05, 0.3), [(0.4, 0.72), (0.95, 1.05), (1.28, 0.95), (1.22, 0.5), (0.95, 0.12), (0.4, 0.02)]),
        "hind": ((0.05, 0.05), [(0.45, 0.02), (0.88, -0.05), (1.0, -0.42), (0.78, -0.8), (0.5, -0.86), (0.2, -0.45)]),
    }
    wings, marks = [], []
    for root, outline in outlines.values():
        rim = curve([root, *outline, root], 17) * size
        share = np.linspace(0.02, 1, 6)[:, None, None]
        middle = np.array([0.12, root[1]]) * size
        flat = middle + share * (rim[None] - middle)
        grid = np.stack([flat[..., 0], 0 * flat[..., 0], flat[..., 1]], -1)
        solid = sheet(grid, 0.085 * size)
        wings.append(solid)
        for tip in rim[3:-3:3]:
            line = middle + np.linspace(0.1, 0.93, 4)[:, None] * (tip - middle)
            wings.append(tube(np.stack([line[:, 0], 0 * line[:, 0], line[:, 1]], 1), np.full(4, 0.055 * size), 8))
        centre = middle + 0.62 * (rim[5:-5].mean(0) - middle)
        marks.append(ellipsoid((centre[0], 0, centre[1]), (0.2 * size, 0.085 * size, 0.2 * size)))
        for tip in rim[4:-4:2]:
            spot = middle + 0.86 * (tip - middle)
            marks.append(ellipsoid((spot[0], 0, spot[1]), (0.075 * size, 0.075 * size, 0.075 * size)))
    turn = rotation(degrees_z=float(np.rad2deg(lift)))
    right, right_marks = transform(join(wings), turn), transform(join(marks), turn)
    line = curve([(0.05, 0.05, 0.55), (0.16, 0.3, 0.8), (0.34, 0.48, 0.95)], 6) * size
    feeler = join([tube(line, np.full(6, 0.04 * size), 8), ellipsoid(line[-1], (0.08 * size,) * 3)])
    zones = {
        "trunk": join([trunk, feeler, mirror_x(feeler)]),
        "wings": join([right, mirror_x(right)]),
        "marks": join([right_marks, mirror_x(right_marks)]),
    }
    yaw = rotation(degrees_x=rng.uniform(-20, 5), degrees_y=rng.uniform(-25, 25))
    return placed(zones, yaw, surface.body.head_top + np.array([0, 0.14 * size, 0]))
