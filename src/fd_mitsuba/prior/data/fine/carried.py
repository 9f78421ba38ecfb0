"""Parts beside, under and on a body: handles, boards, swords, shields, saddles, boots."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import jitter
from fd_mitsuba.prior.data.fine.headwear import Zones
from fd_mitsuba.prior.data.fine.shapes import curve, disc, loop, sheet, strip, torus
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.placed_parts import board
from fd_mitsuba.prior.data.primitives import box, ellipsoid, join, rotation, transform, tube

Rng = np.random.Generator


def handle(surface: Surface, rng: Rng) -> Zones:
    """A thick oval loop on the +x side whose two ends widen where they meet the body."""
    body = surface.body
    tall, out = jitter(rng, 0.42) * body.side_height + 0.06, jitter(rng, 0.42) * body.side_height + 0.1
    radius = jitter(rng, 0.05 + 0.045 * body.side_height, 0.15)
    ends = surface.towards(body.side + np.array([[0, -tall, 0], [0, tall, 0]]), (-1, 0, 0))
    ends[:, 0] = np.clip(ends[:, 0], 0.3 * body.side[0], 1.3 * body.side[0]) - 0.03
    low, high = ends
    edge = max(low[0], high[0])
    line = curve(
        [
            low,
            (edge + 0.62 * out, low[1] - 0.02, low[2]),
            (edge + out, body.side[1], low[2]),
            (edge + 0.68 * out, high[1] + 0.02, low[2]),
            high,
        ],
        21,
    )
    share = np.abs(np.linspace(-1, 1, 21))
    return {"handle": tube(line, radius * np.interp(share, [0, 0.8, 1], [1.0, 1.0, 1.55]), 14, flatten=0.85)}


def skateboard(surface: Surface, rng: Rng) -> Zones:
    """A deck with raised ends, two trucks with axles, four wheels, under the feet."""
    body = surface.body
    half_x = max(body.foot_x * 1.1, 0.22)
    half_z = max(body.foot_z * jitter(rng, 1.3), 0.55, 1.55 * half_x)
    thick, wheel = 0.045, jitter(rng, 0.105, 0.08)
    z = np.linspace(-1, 1, 21) * half_z
    rise = 0.22 * half_z * (np.clip(np.abs(z) / half_z - 0.68, 0, None) / 0.32) ** 1.5
    width = half_x * np.sqrt(np.clip(1.0 - np.clip((np.abs(z) / half_z - 0.7) / 0.31, 0, 1) ** 2.5, 0.01, None))
    centre = np.array([0, body.bottom - thick * 0.6, body.foot_centre_z])
    deck = board(centre, np.stack([rise, z], 1), width, thick, 16, 0.35)
    wheels, trucks = [], []
    for sign in (1, -1):
        at = centre + (0, -thick, sign * half_z * 0.56)
        axle = at - (0, wheel * 1.05, 0)
        trucks.append(box(at - (0, 0.01, 0), (half_x * 0.4, 0.025, 0.1)))
        trucks.append(box((at + axle) / 2, (half_x * 0.22, wheel * 0.55, 0.05)))
        trucks.append(tube([axle - (half_x * 0.8, 0, 0), axle + (half_x * 0.8, 0, 0)], [0.035] * 2))
        wheels += [disc(axle + (side * half_x * 0.78, 0, 0), wheel, 0.065) for side in (1, -1)]
    return {"deck": deck, "wheels": join(wheels), "trucks": join(trucks)}


def sword(surface: Surface, rng: Rng) -> Zones:
    """A straight sword held upright beside the body: blade with a ridge, cross-guard, grip and pommel."""
    body = surface.body
    long, wide = jitter(rng, 1.05), jitter(rng, 0.085)
    share = np.array([0, 0.2, 0.5, 0.86, 0.94, 1.0])
    half = wide * np.array([1, 0.95, 0.88, 0.78, 0.5, 0.04])
    blade = strip(np.stack([0 * share, 0.03 + share * long, 0 * share], 1), (1, 0, 0), half, 0.42 * half + 0.012, 4)
    guard = tube([(-0.24, 0, 0), (-0.1, 0.015, 0), (0.1, 0.015, 0), (0.24, 0, 0)], [0.045, 0.05, 0.05, 0.045], 10)
    grip = tube([(0, -0.02, 0), (0, -0.26, 0)], [0.045, 0.042], 10)
    rings = [torus((0, y, 0), 0.042, 0.018) for y in (-0.07, -0.13, -0.19)]
    pommel = ellipsoid((0, -0.31, 0), (0.065,) * 3)
    at = np.array([body.side[0] + 0.12, body.side[1] + 0.05, body.side[2] + 0.12])
    turn = rotation(rng.uniform(-5, 20), rng.uniform(-25, 25), rng.uniform(-22, 4))
    zones = {"blade": blade, "hilt": join([guard, grip, *rings, pommel])}
    return {name: transform(solid, turn, at) for name, solid in zones.items()}


def shield(surface: Surface, rng: Rng) -> Zones:
    """A curved shield at the side: rounded above and pointed below, or round; with a raised rim and a boss."""
    body = surface.body
    tall = jitter(rng, 0.5) * float(np.clip(body.side_height, 0.6, 1.1))
    wide = 0.8 * tall
    angle = np.linspace(0, 2 * np.pi, 37)
    if rng.random() < 0.65:
        x = wide * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** np.where(np.cos(angle) > 0, 0.6, 1.15)
        y = tall * np.where(np.cos(angle) > 0, 0.85 * np.abs(np.cos(angle)) ** 0.5, 1.25 * np.cos(angle))
    else:
        x, y = 0.92 * tall * np.sin(angle), 0.92 * tall * np.cos(angle)
    rim = np.stack([x, y], 1)
    share = np.linspace(0.03, 1, 7)[:, None, None]
    flat = share * rim[None]
    bulge = 0.16 * tall * (1 - (flat[..., 0] / wide) ** 2)
    plate = sheet(np.stack([flat[..., 0], flat[..., 1], bulge], -1), 0.06)
    edge = loop(np.stack([x, y, 0.16 * tall * (1 - (x / wide) ** 2)], 1)[:-1], 0.045, (0, 0, 1))
    boss = ellipsoid((0, 0.05 * tall, 0.17 * tall), (0.2 * tall, 0.2 * tall, 0.12 * tall))
    cross = [
        strip(np.stack([0 * s, s, 0.165 * tall + 0 * s], 1), (1, 0, 0), 0.05 * tall, 0.045)
        for s in [np.linspace(-0.85, 0.75, 6) * tall]
    ]
    at = surface.towards(body.side * np.array([1, 1, 1]), (-1, 0, 0))[0] + np.array([0.06, 0, 0.06])
    turn = rotation(degrees_y=90 - rng.uniform(0, 35)) @ rotation(degrees_z=rng.uniform(-8, 8))
    zones = {"plate": plate, "rim": join([edge, boss, *cross])}
    return {name: transform(solid, turn, at) for name, solid in zones.items()}


def saddle(surface: Surface, rng: Rng) -> Zones:
    """A seat on the back, raised before and behind, with flaps down the sides, a girth, and stirrups."""
    body = surface.body
    ridge, _ = body.spine(9)
    z0, z1 = ridge[1, 2], ridge[5, 2]
    middle, half = (z0 + z1) / 2, max(abs(z0 - z1) / 2, 0.16) * jitter(rng, 1.0)
    rows, cols = 11, 13
    centre = np.array([0, body.side[1], middle])
    grid, blanket = np.zeros((rows, cols, 3)), np.zeros((rows, cols, 3))
    for i, t in enumerate(np.linspace(-1, 1, rows)):
        spread = np.deg2rad(np.linspace(-62, 62, cols) * (1.0 - 0.25 * t**2))
        wide = np.deg2rad(np.linspace(-84, 84, cols))
        for angles, target, lift in ((spread, grid, 0.06), (wide, blanket, 0.03)):
            out = np.stack([np.sin(angles), np.cos(angles), 0 * angles], 1)
            start = centre + (0, 0, (1.0 if target is grid else 1.2) * t * half) + out * 1.0
            points, hit = surface.cast(start, -out)
            length = np.where(hit, ((points - centre) * out).sum(1), np.nan)
            usual = np.nanmedian(length) if np.isfinite(length).any() else body.side[0]
            length = np.clip(np.where(np.isfinite(length), length, usual), 0.75 * usual, 1.3 * usual)
            raised = lift + (0.2 * half + 0.05) * abs(t) ** 3 * np.cos(angles * 1.3).clip(0) if target is grid else lift
            target[i] = centre + (0, 0, (1.0 if target is grid else 1.2) * t * half) + out * (length + raised)[:, None]
    pommel = ellipsoid(grid[0 if grid[0, 0, 2] > grid[-1, 0, 2] else -1, cols // 2] + (0, 0.04, 0), (0.06, 0.1, 0.06))
    stirrups = []
    for sign in (1, -1):
        side = grid[rows // 2, -1 if grid[0, -1, 0] * sign > 0 else 0]
        low = side + np.array([sign * 0.03, -0.34 * body.side_height, 0])
        stirrups.append(strip(side + np.linspace(0, 1, 4)[:, None] * (low - side), (0, 0, 1), 0.045, 0.022))
        stirrups.append(torus(low - (0, 0.08, 0), 0.085, 0.03, axis=(0.3 * sign, 0, 1)))
    return {
        "seat": join([sheet(grid, 0.07), pommel]),
        "blanket": sheet(blanket, 0.04),
        "stirrups": join(stirrups),
    }


def boots(surface: Surface, rng: Rng) -> Zones:
    """A boot on every foot: a shaft with a cuff, a rounded toe, a sole with a heel."""
    shafts, soles = [], []
    tall = jitter(rng, 0.3)
    for at, half in surface.feet():
        wide = float(np.clip(half, 0.07, 0.2)) * 1.25
        high = float(np.clip(tall, 1.2 * wide, 0.36))
        shafts.append(tube([at + (0, 0.1 * high, -0.1 * wide), at + (0, high, -0.1 * wide)], [wide, 1.04 * wide], 14))
        shafts.append(torus(at + (0, high, -0.1 * wide), wide * 1.04, 0.2 * wide))
        shafts.append(ellipsoid(at + (0, 0.55 * wide, 0.85 * wide), (0.95 * wide, 0.68 * wide, 1.15 * wide)))
        soles.append(box(at + (0, 0.02, 0.55 * wide), (1.08 * wide, 0.04, 1.65 * wide)))
        soles.append(box(at + (0, -0.01, -0.65 * wide), (0.95 * wide, 0.07, 0.5 * wide)))
    if not shafts:
        return {}
    return {"boots": join(shafts), "soles": join(soles)}
