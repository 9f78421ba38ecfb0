"""Parts worn on face, neck, shoulders and back: glasses, scarves, bow ties, capes, backpacks."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import jitter
from fd_mitsuba.prior.data.fine.headwear import Zones
from fd_mitsuba.prior.data.fine.shapes import curve, disc, loop, sheet, strip, torus, unit
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import Solid, box, ellipsoid, join, mirror_x, rotation, transform, tube

Rng = np.random.Generator


def glasses(surface: Surface, rng: Rng) -> Zones:
    """Two round rims with thin lenses before the eyes, a bridge, and temples that hook behind the ears."""
    size, body = surface.size, surface.body
    eyes = body.eyes()
    ring, thick = jitter(rng, 0.46) * size, jitter(rng, 0.105) * size
    across = max(0.5 * (eyes[0, 0] - eyes[1, 0]), ring * 1.12)
    height = eyes[0, 1] - (0.12 * size if body.upright else 0.0)
    probe = np.array([[x, height + y, body.forehead[2]] for x in (across, 0.6 * across) for y in (0, -0.5 * ring)])
    front = surface.towards(probe, (0, 0, -1))[:, 2]
    z = max(eyes[:, 2].max(), float(np.median(front))) + 0.7 * thick
    angle = np.arange(22) * 2 * np.pi / 22
    squash = rng.uniform(0.85, 1.05)
    points = np.stack([across + ring * np.cos(angle), height + squash * ring * np.sin(angle), np.full(22, z)], 1)
    rim = loop(points, thick, (0, 0, 1.0))
    lens = transform(disc((0, 0, 0), ring, 0.2 * thick, axis=(0, 0, 1.0)), np.diag([1, squash, 1]), (across, height, z))
    rear = surface.head[2] - 0.15 * size
    levels = np.linspace(z - 0.25 * size, rear, 6)
    skin = surface.towards(np.stack([np.full(6, 0.5 * size), np.full(6, height + 0.1 * size), levels], 1), (-1, 0, 0))
    out = np.clip(skin[:, 0], 0.5 * size, 1.45 * size) + 0.5 * thick
    out = np.maximum.accumulate(np.minimum(out, out.max()))
    outer = across + ring
    path = [(outer, height + 0.12 * size, z), (max(outer, out[0]), height + 0.12 * size, z - 0.12 * size)]
    path += [
        (max(x, 0.85 * outer if k < 2 else x), height + 0.12 * size, level)
        for k, (x, level) in enumerate(zip(out, levels, strict=True))
    ]
    path += [(out[-1] * 0.97, height - 0.22 * size, rear - 0.22 * size)]
    temple = tube(curve(path, 16), np.full(16, 0.75 * thick), 8)
    bridge_line = curve(
        [
            (-across + ring * 0.93, height + 0.25 * ring, z),
            (0, height + 0.42 * ring, z + 0.4 * thick),
            (across - ring * 0.93, height + 0.25 * ring, z),
        ],
        7,
    )
    zones = {
        "frame": join([rim, mirror_x(rim), temple, mirror_x(temple), tube(bridge_line, np.full(7, 0.9 * thick))]),
        "lenses": join([lens, mirror_x(lens)]),
    }
    return zones


def scarf(surface: Surface, rng: Rng) -> Zones:
    """A thick roll of cloth around the neck and two ends with fringes that hang in front."""
    size = surface.size
    centre, axis, reach = surface.neck()
    skin = surface.ring(centre, axis, reach, 28, 1.35)
    thick = jitter(rng, 0.2) * size
    out = unit(skin - centre)
    wave = 0.12 * thick * np.cos(np.arange(28) * 2 * np.pi * 5 / 28)[:, None]
    points = skin + out * (0.45 * thick + wave) + axis * (0.06 * size * np.cos(np.arange(28) * 2 * np.pi / 28))[:, None]
    rolls = [
        loop(points + axis * 0.55 * thick, thick * 0.8, axis, 0.8),
        loop(points - axis * 0.6 * thick, thick * 0.85, axis, 0.85),
    ]
    ends = []
    long = jitter(rng, 1.5) * size
    for k, share in ((27, 1.0), (2, 0.75)):
        top = points[k] + out[k] * 0.5 * thick
        share_down = np.linspace(0, 1, 7)
        line = top + np.stack(
            [0.15 * size * share_down * np.sign(top[0] + 1e-6), -long * share * share_down, 0 * share_down], 1
        )
        front = surface.towards(line, (0, 0, -1))
        away = np.clip(front[:, 2] - line[:, 2], -0.3 * size, 0.3 * size)
        line[:, 2] += np.where(np.arange(7) > 0, away + 0.5 * thick, 0)
        ends.append(strip(line, (1, 0, 0), 0.24 * size, 0.3 * thick, 10))
        ends += [
            tube([line[-1] + (x * size, 0, 0), line[-1] + (x * size, -0.17 * size, 0)], [0.05 * size, 0.04 * size], 8)
            for x in (-0.18, -0.06, 0.06, 0.18)
        ]
    knot = ellipsoid(points[0] + out[0] * 0.6 * thick, (0.22 * size, 0.24 * size, 0.2 * size))
    return {"scarf": join([*rolls, knot, *ends])}


def bow_tie(surface: Surface, rng: Rng) -> Zones:
    """A bow at the front of the neck: two flaring folded wings and a knot, on a thin collar."""
    size = surface.size
    centre, axis, reach = surface.neck()
    skin = surface.ring(centre, axis, reach, 28, 1.3)
    out = unit(skin - centre)
    front = out[0]
    at = skin[0] + front * 0.12 * size
    half = jitter(rng, 0.8) * size
    wings = []
    side = np.array([1.0, 0, 0])
    up = unit(np.cross(front, side))
    share, v = np.linspace(0.05, 1, 8)[:, None], np.linspace(-1, 1, 9)[None]
    tall = 0.12 + 0.38 * share
    grid = (
        share[..., None] * half * side
        + (tall * v * size)[..., None] * up
        + ((0.09 * np.cos(v * np.pi * 2.0) * share + 0.03) * size)[..., None] * front
    )
    wing = sheet(grid, 0.17 * size)
    wings = [Solid(wing.vertices + at, wing.faces)]
    mirrored = mirror_x(Solid(wings[0].vertices * 1.0, wings[0].faces))
    knot = ellipsoid(at + front * 0.05 * size, (0.16 * size, 0.2 * size, 0.16 * size), np.stack([side, up, front], 1))
    collar = loop(skin + out * 0.03 * size, 0.09 * size, axis, 0.6)
    return {"bow": join([*wings, mirrored]), "knot": join([knot, collar])}


def cape(surface: Surface, rng: Rng) -> Zones:
    """A cloth with folds: from the shoulders down the back, or over an animal's back like a rug; with a collar."""
    return _hanging_cape(surface, rng) if surface.body.upright else _rug(surface, rng)


def _hanging_cape(surface: Surface, rng: Rng) -> Zones:
    body = surface.body
    centre, _, _ = surface.neck()
    shoulder = float(np.clip(1.12 * body.side[0], 0.25, 0.8))
    low = body.bottom + rng.uniform(0.05, 0.25) * (centre[1] - body.bottom)
    rows, cols = 15, 31
    u, v = np.linspace(-1, 1, cols)[None], np.linspace(0, 1, rows)[:, None]
    height = centre[1] + (low - centre[1]) * v
    half = shoulder * (1.0 + 0.55 * jitter(rng, 1.0) * v)
    wrap = 1.25 * (1 - 0.5 * v)  # radians that the cloth reaches round the sides
    x = half * np.sin(u * wrap) / np.sin(wrap)
    probe = np.stack([np.zeros(rows), height[:, 0], np.zeros(rows)], 1)
    behind = surface.towards(probe, (0, 0, 1))[:, 2]
    behind = np.minimum.accumulate(np.clip(behind, -0.9, centre[2] - 0.08))
    depth = (behind - 0.06 - 0.22 * body.reach * np.linspace(0, 1, rows) ** 1.4)[:, None]
    folds = 0.055 * v**0.7 * np.cos(u * np.pi * rng.integers(4, 6))
    z = depth + (centre[2] + 0.04 - depth) * (1 - np.cos(u * wrap)) / (1 - np.cos(1.35)) * (1 - 0.55 * v) + folds
    lift = -0.16 * shoulder * np.abs(u) ** 2 * (1 - v)
    cloth = sheet(np.stack([x, height + lift, z], -1), 0.055)
    collar_line = np.stack([x[0], height[0] + lift[0] + 0.03, z[0]], 1)
    collar = tube(collar_line, np.full(cols, 0.055), 8)
    clasps = [ellipsoid(collar_line[k] + (0, 0, 0.03), (0.06,) * 3) for k in (0, -1)]
    return {"cloth": join([cloth, collar]), "clasps": join(clasps)}


def _rug(surface: Surface, rng: Rng) -> Zones:
    body = surface.body
    ridge, _ = body.spine(9)
    z0, z1 = ridge[0, 2] + 0.05, ridge[7, 2]
    rows, cols = 13, 29
    centre_y = body.side[1]
    grid = np.zeros((rows, cols, 3))
    spread = np.deg2rad(np.linspace(-100, 100, cols))
    for i, t in enumerate(np.linspace(0, 1, rows)):
        centre = np.array([0, centre_y, z0 + t * (z1 - z0)])
        out = np.stack([np.sin(spread), np.cos(spread), 0 * spread], 1)
        points, hit = surface.cast(centre + out * 1.1, -out)
        length = np.where(hit, ((points - centre) * out).sum(1), np.nan)
        usual = np.nanmedian(length) if np.isfinite(length).any() else body.side[0]
        length = np.clip(np.where(np.isfinite(length), length, usual), 0.8 * usual, 1.25 * usual)
        hang = np.clip((np.abs(spread) - 1.0) / 0.75, 0, 1)
        folds = 0.035 * hang * np.cos(t * np.pi * 7)
        grid[i] = centre + out * (length + 0.045 + 0.05 * hang + folds)[:, None]
        grid[i, :, 1] -= 0.25 * body.side_height * hang**2
    cloth = sheet(grid, 0.055)
    collar = tube(grid[0], np.full(cols, 0.05), 8)
    return {"cloth": join([cloth, collar]), "clasps": ellipsoid(grid[0, cols // 2] + (0, 0.05, 0.02), (0.06,) * 3)}


def backpack(surface: Surface, rng: Rng) -> Zones:
    """A rounded pack with a flap, pockets and a loop, and two straps that run round the shoulders or the belly."""
    body = surface.body
    points, outward = body.spine(5)
    wide, tall = jitter(rng, 0.3) * max(body.reach, 0.55), jitter(rng, 0.36) * max(body.reach, 0.55)
    deep = 0.6 * wide
    if body.upright:
        at, away, turn = (points[2] + points[3]) / 2, np.array([0.0, 0.0, -1.0]), np.eye(3)
    else:
        at, away, turn = (points[1] + points[2]) / 2, np.array([0.0, 1.0, 0.0]), rotation(degrees_x=90)
    along = turn @ np.array([0, 1.0, 0])
    middle = at + away * deep * 0.85

    def piece(shift: np.ndarray, half: tuple[float, float, float]) -> Solid:
        return transform(box((0, 0, 0), half, turn), shift=middle + shift)

    pack = piece(np.zeros(3), (wide, tall, deep))
    pocket = piece(away * deep * 1.08 - along * tall * 0.42, (wide * 0.66, tall * 0.4, deep * 0.42))
    buckle = piece(away * deep * 1.5 - along * tall * 0.2, (wide * 0.12, tall * 0.12, deep * 0.12))
    sides = [
        piece(np.array([s * wide * 1.05, 0, 0]) - along * tall * 0.45, (wide * 0.22, tall * 0.35, deep * 0.6))
        for s in (1, -1)
    ]
    flap = piece(along * tall * 0.72 + away * deep * 0.12, (wide * 1.07, tall * 0.36, deep * 1.08))
    top = torus(
        middle + along * tall * 1.08,
        0.24 * wide,
        0.07 * wide,
        axis=np.array([0.0, 0, 1.0]) if body.upright else (0, 1.0, 0),
    )
    straps = _shoulder_straps(surface, middle, wide, tall) if body.upright else _girths(surface, middle, tall)
    return {
        "pack": join([pack, *sides]),
        "pocket": join([pocket, buckle]),
        "flap": flap,
        "straps": join([*straps, top]),
    }


def _shoulder_straps(surface: Surface, middle: np.ndarray, wide: float, tall: float) -> list[Solid]:
    """Bands from the pack's top over the shoulder, down the chest, and under the arm back to its lower corners."""
    body = surface.body
    neck = surface.neck()[0]
    x = float(np.clip(0.72 * wide, 0.1, 0.8 * max(body.side[0], 0.15)))
    top_y, low_y = min(middle[1] + 0.8 * tall, neck[1]), middle[1] - 0.75 * tall
    centre = np.array([x, (top_y + low_y) / 2, 0.35 * neck[2]])
    angle = np.deg2rad(np.linspace(150, -50, 15))  # 90 is up, 0 the front
    out = np.stack([0 * angle, np.sin(angle), np.cos(angle)], 1)
    limit = np.where(np.sin(angle) > 0.3, (neck[1] + 0.03 - centre[1]) / np.maximum(np.sin(angle), 0.3), 1.4)
    points, hit = surface.cast(centre + out * limit[:, None], -out)
    radius = np.where(hit, ((points - centre) * out).sum(1), np.nan)
    usual = np.nanmedian(radius) if np.isfinite(radius).any() else 0.3
    radius = np.clip(np.where(np.isfinite(radius), radius, usual), 0.5 * usual, 1.5 * usual)
    radius = np.convolve(np.pad(radius, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    line = centre + out * (radius + 0.03)[:, None]
    side_x = max(1.02 * surface.towards(np.array([[0, low_y, 0.3 * line[-1, 2]]]), (-1, 0, 0))[0, 0], x)
    side_x = min(side_x, 1.25 * max(body.side[0], x))
    line = np.concatenate(
        [
            [[x * 0.9, middle[1] + 0.85 * tall, middle[2]]],
            line,
            [[side_x, low_y, 0.2 * line[-1, 2]], [0.9 * wide, low_y, middle[2] * 0.8]],
        ]
    )
    band = strip(curve(line, 30), (1, 0, 0.15), 0.2 * wide, 0.035, 8)
    return [band, mirror_x(band)]


def _girths(surface: Surface, middle: np.ndarray, tall: float) -> list[Solid]:
    """Two bands around the body, under the pack's ends."""
    bands = []
    for z in (middle[2] + 0.55 * tall, middle[2] - 0.55 * tall):
        centre = np.array([0, surface.body.side[1], z])
        skin = surface.ring(centre, (0, 0, 1.0), 1.2, 30, 1.35)
        out = unit(skin - centre)
        bands.append(loop(skin + out * 0.02, 0.06, (0, 0, 1.0), 0.5))
    return bands
