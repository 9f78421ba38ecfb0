"""Parts that grow out of a body: horns, antlers, tusks, tails, spikes, fins."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import jitter
from fd_mitsuba.prior.data.fine.headwear import Zones
from fd_mitsuba.prior.data.fine.shapes import cone, curve, strip, unit
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import Solid, ellipsoid, join, mirror_x, tube

Rng = np.random.Generator


def both(*solids: Solid) -> Solid:
    right = join(list(solids))
    return join([right, mirror_x(right)])


def horn(surface: Surface, rng: Rng) -> Zones:
    """One straight, slender horn with a spiral ridge."""
    size, body = surface.size, surface.body
    length, radius = jitter(rng, 2.2) * size, jitter(rng, 0.27) * size
    way = unit(body.horn_direction + rng.normal(size=3) * (0.03, 0.08, 0.08))
    foot = body.forehead - way * radius
    core = cone(foot, foot + way * (length + radius), radius * 0.92)
    across = unit(np.cross(way, (1.0, 0, 0)))
    over = np.cross(way, across)
    share = np.linspace(0.02, 0.96, 56)
    girth = radius * (1 - 0.93 * share)
    angle = share * 2 * np.pi * 5.5
    points = (
        foot
        + way * (share * (length + radius))[:, None]
        + girth[:, None] * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * over)
    )
    ridge = tube(points, np.maximum(0.28 * girth, 0.008), 8)
    return {"horn": core, "ridge": ridge}


def horns(surface: Surface, rng: Rng) -> Zones:
    """Two thick curved horns at the sides of the head, ringed, bent outwards and up."""
    size, body = surface.size, surface.body
    length, radius = jitter(rng, 1.5) * size, jitter(rng, 0.3) * size
    root = body.head_top + np.array([size * 0.42, -size * 0.3, 0])
    line = curve(
        [
            root,
            root + length * np.array([0.4, 0.08, 0]),
            root + length * np.array([0.72, 0.34, 0.02]),
            root + length * np.array([0.74, 1.0, 0.12]),
        ],
        26,
    )
    share = np.linspace(0, 1, 26)
    rings = 1 + 0.13 * np.cos(share * 2 * np.pi * 6) * (share < 0.75)
    return {"horns": both(tube(line, radius * rings * np.interp(share, [0, 0.4, 1], [1, 0.86, 0.1])))}


def antlers(surface: Surface, rng: Rng) -> Zones:
    """Two beams that bow out and up, with four tines each."""
    size = surface.size
    length, radius = jitter(rng, 2.5) * size, jitter(rng, 0.15) * size
    root = surface.body.head_top + np.array([size * 0.38, -size * 0.2, 0])
    line = curve(
        [
            root,
            root + length * np.array([0.2, 0.3, -0.12]),
            root + length * np.array([0.5, 0.62, -0.12]),
            root + length * np.array([0.5, 1.0, 0.06]),
        ],
        16,
    )
    share = np.linspace(0, 1, 16)
    solids = [tube(line, radius * (1.15 - 0.65 * share)), ellipsoid(root + (0, 0.1 * size, 0), (1.5 * radius,) * 3)]
    for at, way, long in (
        (3, (0.05, 0.5, 1.0), 0.34),
        (7, (0.35, 1.0, 0.5), 0.34),
        (10, (-0.5, 1.0, 0.25), 0.3),
        (12, (0.8, 0.75, -0.2), 0.28),
    ):
        way = unit(np.array(way) + rng.normal(size=3) * 0.08)
        tip = line[at] + length * long * jitter(rng, 1.0) * way
        middle = (line[at] + tip) / 2 + (0, -0.03 * length, 0)
        solids.append(tube(curve([line[at], middle, tip], 6), radius * np.linspace(0.92, 0.4, 6)))
    return {"antlers": both(*solids)}


def tusks(surface: Surface, rng: Rng) -> Zones:
    """Two smooth curved tusks beside the mouth, forward and up."""
    size = surface.size
    length, radius = jitter(rng, 1.25) * size, jitter(rng, 0.17) * size
    mouth = surface.mouth()
    root = np.array([0.34 * size, mouth[1], mouth[2] - 0.12 * size])
    line = curve(
        [
            root,
            root + length * np.array([0.14, -0.3, 0.35]),
            root + length * np.array([0.2, -0.18, 0.78]),
            root + length * np.array([0.16, 0.3, 1.02]),
        ],
        14,
    )
    return {"tusks": both(tube(line, radius * np.interp(np.linspace(0, 1, 14), [0, 0.3, 1], [1, 0.95, 0.12])))}


def tail(surface: Surface, rng: Rng) -> Zones:
    """A thick tail that swings down and up into a bushy end with tufts."""
    body = surface.body
    root, length = body.rear(), jitter(rng, 0.75) * float(np.clip(body.reach, 0.6, 1.0))
    radius = 0.115 * length
    line = curve(
        np.array([(0, 0.02, 0.12), (0, -0.06, -0.2), (0, 0.05, -0.5), (0, 0.35, -0.72), (0, 0.78, -0.74)]) * length
        + root,
        14,
    )
    girth = radius * np.interp(np.linspace(0, 1, 14), [0, 0.3, 0.6, 0.82, 1], [0.9, 1.0, 1.25, 1.6, 0.4])
    tufts = []
    for k in range(6, 14, 2):
        way = unit(np.gradient(line, axis=0)[k])
        across = unit(np.cross(way, (1.0, 0, 0)))
        for angle in np.arange(4) * 2 * np.pi / 4 + k:
            out = np.cos(angle) * across + np.sin(angle) * np.cross(way, across)
            foot = line[k] + out * girth[k] * 0.55
            tufts.append(cone(foot, foot + (0.3 * out + way) * girth[k] * 1.1, 0.62 * girth[k]))
    return {"tail": tube(line, girth), "tufts": join(tufts)}


def spikes(surface: Surface, rng: Rng) -> Zones:
    """A row of separate pointed spikes along the back, the middle ones the longest."""
    feet, outward = surface.body.spine(7)
    step = np.linalg.norm(np.diff(feet, axis=0), axis=1).mean()
    tall = jitter(rng, 0.32) * np.array([0.65, 0.9, 1.05, 1.1, 1.05, 0.85, 0.6])
    radius = float(np.clip(0.52 * step, 0.06, 0.13))
    cones = [cone(f - up * 0.05, f + up * h, radius) for f, up, h in zip(feet, outward, tall, strict=True)]
    return {"spikes": join(cones)}


def fin(surface: Surface, rng: Rng) -> Zones:
    """One shark's fin on the back, swept to the rear, thick at the front edge and sharp behind."""
    body = surface.body
    points, outward = body.spine(7)
    at, up = points[2], outward[2]
    back = unit(np.array([0, -1.0, -0.35])) if body.upright else np.array([0, 0, -1.0])
    up = unit(up - (up @ back) * back)
    tall, long = jitter(rng, 0.5) * max(body.reach, 0.6), jitter(rng, 0.6) * max(body.reach, 0.6)
    share = np.linspace(0, 1, 9)
    front = 0.95 * share**1.25
    chord = np.interp(share, [0, 0.5, 0.85, 1], [1.0, 0.52, 0.22, 0.08])
    centres = at + (share * tall - 0.06)[:, None] * up + ((front * 0.75 + chord / 2 - 0.5) * long)[:, None] * back
    return {"fin": strip(centres, back, chord / 2 * long, 0.11 * long * (1 - 0.75 * share), 16)}
