"""Parts that grow out of a body: wings, horns, antlers, tails, spikes."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, head_size, jitter
from fd_mitsuba.prior.data.primitives import Solid, join, mirror_x, sweep, tube

Rng = np.random.Generator


def wings(body: Body, rng: Rng) -> Solid:
    """Two feathered wings, raised and swept back, broad at the wrist and pointed at the tip."""
    span, chord = jitter(rng, 1.0) * body.reach, jitter(rng, 0.5) * body.reach
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
    size = head_size(body)
    length, radius = jitter(rng, 2.2) * size, jitter(rng, 0.27) * size
    tip = body.forehead + body.horn_direction * length
    return tube(
        [body.forehead - body.horn_direction * radius, (body.forehead + tip) / 2, tip], [radius, radius * 0.55, 0.012]
    )


def horns(body: Body, rng: Rng) -> Solid:
    """Two thick curved horns at the sides of the head, bent outwards and up."""
    size = head_size(body)
    length, radius = jitter(rng, 1.5) * size, jitter(rng, 0.3) * size
    root = body.head_top + np.array([size * 0.45, -size * 0.3, 0])
    bend = root + length * np.array([0.62, 0.22, 0])
    tip = root + length * np.array([0.68, 1.0, 0.12])
    right = tube(
        [root, (root + bend) / 2, bend, (bend + tip) / 2 + (size * 0.12, 0, 0), tip],
        radius * np.array([1.0, 0.95, 0.85, 0.6, 0.15]),
    )
    return join([right, mirror_x(right)])


def antlers(body: Body, rng: Rng) -> Solid:
    """Two branching antlers on top of the head."""
    size = head_size(body)
    length, radius = jitter(rng, 2.4) * size, jitter(rng, 0.15) * size
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


def tail(body: Body, rng: Rng) -> Solid:
    """One thick tail at the rear that swings down and then up into a bushy end."""
    root, length = body.rear(), jitter(rng, 0.75) * max(body.reach, 0.6)
    radius = 0.12 * length
    along = np.array([(0, 0.02, 0.12), (0, -0.06, -0.2), (0, 0.05, -0.5), (0, 0.35, -0.72), (0, 0.72, -0.74)])
    return tube(root + along * length, radius * np.array([0.9, 1.0, 1.25, 1.6, 0.5]))


def spikes(body: Body, rng: Rng) -> Solid:
    """A row of broad pointed spikes along the back, the middle one the longest."""
    feet, outward = body.spine(6)
    step = np.linalg.norm(np.diff(feet, axis=0), axis=1).mean()
    tall = jitter(rng, 0.3) * np.array([0.7, 0.95, 1.1, 1.1, 0.9, 0.6])
    radius = float(np.clip(0.55 * step, 0.06, 0.14))
    cones = [
        tube([foot - up * 0.05, foot + up * height * 0.5, foot + up * height], [radius, radius * 0.6, 0.012])
        for foot, up, height in zip(feet, outward, tall, strict=True)
    ]
    return join(cones)
