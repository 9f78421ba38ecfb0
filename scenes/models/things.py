"""The mug, the vase, the cup with its saucer, and the tree stump."""

from __future__ import annotations

import numpy as np

from models.equines import GROUND
from models.files import save
from models.finishes import mottled
from models.model import Model
from models.noise import cloud, strands
from models.shapes import box, curve, ellipsoid, lathe, torus, tube


def _angle(p: np.ndarray) -> np.ndarray:
    return np.arctan2(p[:, 0], p[:, 2])


def mug(seed: int) -> None:
    """A tall mug of coffee without a handle, 12 units (centimetres) tall: blue glaze that ran down over raw clay."""
    glaze, clay = (0.035, 0.16, 0.28), (0.55, 0.40, 0.27, 0.75)
    cup = Model(glaze, 0.13)
    outside = [(0, 0.02), (0.235, 0.02), (0.258, 0.10), (0.265, 0.5), (0.262, 0.98)]
    inside = [(0.222, 0.98), (0.225, 0.87), (0, 0.87)]
    cup.add(lathe(outside + inside, 0.018))

    def below_the_drips(p: np.ndarray) -> np.ndarray:
        turn = _angle(p)
        drips = 0.045 * np.sin(5 * turn) + 0.03 * np.sin(11 * turn + 1) + 0.02 * np.sin(17 * turn)
        outer = 0.23 - np.hypot(p[:, 0], p[:, 2])
        return np.maximum(p[:, 1] - 0.24 - drips, np.where(p[:, 1] > 0.1, outer, -1))

    cup.paint(below_the_drips, clay, 0.006)
    cup.paint(lathe([(0, 0.80), (0.232, 0.80), (0.232, 0.92), (0, 0.92)]), (0.035, 0.014, 0.006, 0.06), 0.008)
    cup.paint(lathe([(0.24, 0.80), (0.40, 0.80), (0.40, 0.84), (0.2, 0.84)]), (0.75, 0.70, 0.6, 0.2), 0.01)
    cup.paint(lathe([(0.2, 0.965), (0.40, 0.965), (0.40, 1.1), (0.2, 1.1)]), (0.16, 0.10, 0.06, 0.2), 0.02)
    cup.finish = mottled(0.12, 0.22, 0.12, 0.03)
    bounds = ((-0.4, -0.1, -0.4), (0.4, 1.1, 0.4))
    save("mug/mug", cup, bounds, 0.0235, seed=seed, texture=768, scale=12, place=(5, 0.5, -8))


def vase(seed: int) -> None:
    """A wide porcelain vase with cobalt-blue bands, leaves and a meander; 0.95 units tall, 1.5 wide."""
    white, cobalt = np.array([0.80, 0.81, 0.80]), np.array([0.015, 0.045, 0.26])
    outer = [(0.34, 0.0), (0.36, 0.04), (0.52, 0.14), (0.70, 0.30), (0.74, 0.44), (0.66, 0.60), (0.42, 0.74)]
    outer += [(0.26, 0.82), (0.235, 0.88), (0.29, 0.94)]
    profile = np.array(curve([(r, y, 0) for r, y in outer], np.zeros(len(outer)))[0])[:, :2]
    inner = profile[::-1] - np.array([0.065, 0.0])
    inner = inner[inner[:, 1] > 0.06]
    model = Model(tuple(white), 0.1)
    model.add(lathe([(0, 0.0), *map(tuple, profile), *map(tuple, inner), (0, 0.06)], 0.02))

    def painted(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        turn, y = _angle(p), p[:, 1]
        ink = np.zeros(len(p))
        for low, high in ((0.055, 0.075), (0.10, 0.115), (0.635, 0.65), (0.69, 0.715), (0.905, 0.96)):
            ink = np.maximum(ink, _between(y, low, high, 0.004))
        # Eight flowers of eight petals around the belly, with leaves between them.
        count = 8
        local = (turn / (2 * np.pi) * count) % 1 - 0.5
        across, up = local * 2 * np.pi / count * 0.72, (y - 0.40) * 1.25
        radius, spoke = np.hypot(across, up), np.arctan2(up, across)
        petals = 0.085 + 0.06 * np.abs(np.cos(4 * spoke))
        ink = np.maximum(ink, np.clip((petals - radius) / 0.006, 0, 1) * np.where(radius < 0.035, 0, 1))
        ink = np.maximum(ink, np.clip((0.022 - radius) / 0.006, 0, 1))
        beside = np.abs(local) - 0.5
        leaf = 0.05 * np.cos(np.clip((y - 0.38) / 0.16, -1, 1) * np.pi / 2)
        ink = np.maximum(ink, np.clip((leaf - np.abs(beside) * 0.56) / 0.006, 0, 1) * 0.85)
        zigzag = 0.16 + 0.045 * (2 * np.abs((turn / (2 * np.pi) * 24) % 1 - 0.5))
        ink = np.maximum(ink, np.clip((0.009 - np.abs(y - zigzag)) / 0.004, 0, 1))
        ink *= np.where(normals[:, 0] * p[:, 0] + normals[:, 2] * p[:, 2] > -0.02, 1, 0)  # not on the inside
        ink *= 0.88 + 0.2 * cloud(p, 9, seed)
        result = looks.copy()
        result[:, :3] = white * (1 - ink[:, None]) + cobalt * ink[:, None]
        result[:, :3] *= (1 + 0.03 * cloud(p, 5, seed + 9))[:, None]
        return result

    model.finish = painted
    bounds = ((-0.9, -0.1, -0.9), (0.9, 1.1, 0.9))
    save("vase/vase", model, bounds, 0.039, seed=seed, texture=768, scale=0.3, place=(0, 0.75, 0))


def cup(seed: int) -> None:
    """A wide cup with a handle on a saucer, and orange juice in it: three meshes. The saucer is 1.7 units wide."""
    cream, rim = (0.74, 0.66, 0.52), (0.60, 0.13, 0.05, 0.15)
    bowl = Model(cream, 0.15)
    outside = [(0, 0.07), (0.24, 0.07), (0.26, 0.12), (0.40, 0.26), (0.47, 0.48), (0.49, 0.80)]
    inside = [(0.435, 0.80), (0.42, 0.48), (0.34, 0.30), (0.2, 0.17), (0, 0.16)]
    bowl.add(lathe(outside + inside, 0.014))
    bowl.add(torus((-0.53, 0.52, 0), 0.16, 0.045, (90, 0, 0)), 0.04)
    bowl.cut(lathe([(0, 0.19), (0.19, 0.19), (0.33, 0.32), (0.405, 0.48), (0.42, 0.9), (0, 0.9)]))
    bowl.paint(lathe([(0.3, 0.785), (0.6, 0.785), (0.6, 0.9), (0.3, 0.9)]), rim, 0.01)
    for y in (0.60, 0.66):
        bowl.paint(lathe([(0.45, y), (0.6, y), (0.6, y + 0.02), (0.45, y + 0.02)]), rim, 0.006)
    bowl.finish = mottled(0.2, 0.04, 0.05)
    bounds = ((-0.85, -0.05, -0.6), (0.6, 0.95, 0.6))
    save("cup_straw/cup", bowl, bounds, 0.033, seed=seed, place=(0, 0, 0))

    saucer = Model(cream, 0.15)
    profile = [(0, 0.0), (0.36, 0.0), (0.62, 0.06), (0.83, 0.15), (0.83, 0.18), (0.60, 0.10), (0.36, 0.05), (0, 0.05)]
    saucer.add(lathe(profile, 0.012))
    saucer.paint(lathe([(0.78, 0), (1, 0), (1, 0.5), (0.78, 0.5)]), rim, 0.01)
    saucer.finish = bowl.finish
    save("cup_straw/saucer", saucer, ((-0.95, -0.1, -0.95), (0.95, 0.3, 0.95)), 0.04, seed=seed)

    drink = Model((0.85, 0.36, 0.02), 0.08)
    drink.add(lathe([(0, 0.2), (0.18, 0.2), (0.33, 0.35), (0.41, 0.5), (0.425, 0.7), (0, 0.7)]))
    for x, z, size in (
        (0.2, 0.1, 0.03),
        (0.26, 0.02, 0.022),
        (-0.1, 0.3, 0.026),
        (-0.25, -0.18, 0.03),
        (-0.3, -0.1, 0.02),
    ):
        drink.paint(ellipsoid((x, 0.7, z), (size, 0.05, size)), (0.92, 0.60, 0.15), 0.006)
    drink.finish = mottled(0.25, 0.18, 0.1)
    save("cup_straw/juice", drink, ((-0.5, 0.1, -0.5), (0.5, 0.8, 0.5)), 0.036, seed=seed)


def stump(seed: int) -> None:
    """A mossy tree stump with roots and two mushrooms, open below as a scan is; 0.75 units tall, 1.9 wide."""
    bark, pale, moss = (0.14, 0.085, 0.05), (0.58, 0.38, 0.19), np.array([0.10, 0.17, 0.025])
    body = [tube([(0, -0.2, 0), (0.02, 0.3, 0), (0, 1.0, 0.02)], [0.66, 0.52, 0.50])]
    for turn, reach, size in (
        (10, 0.95, 0.19),
        (70, 0.85, 0.17),
        (135, 0.98, 0.2),
        (200, 0.9, 0.18),
        (260, 0.95, 0.2),
        (318, 0.85, 0.16),
    ):
        c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
        path = [(0.38 * c, 0.32, 0.38 * s), (0.66 * c, 0.10, 0.66 * s), (reach * c, -0.02, reach * s)]
        body.append(tube(*curve(path, [size, size * 0.85, size * 0.4])))

    smooth = Model(bark)
    for shape in body:
        smooth.add(shape, 0.16)

    def trunk(p: np.ndarray) -> np.ndarray:
        turn = _angle(p)
        furrow = np.abs(np.sin(9 * turn + 2.2 * np.sin(3 * p[:, 1] * 2 + turn) * 0.5)) ** 0.7
        return smooth.distance(p) + 0.045 * (0.6 - furrow) * np.clip((p[:, 1] + 0.3) * 2, 0, 1)

    model = Model(bark, 0.9)
    model.add(trunk)
    model.cut(box((0, 1.75, 0), (2, 1.0, 2), 0.0, (4, 0, -3)))
    red = (0.55, 0.03, 0.015, 0.25)
    for x, y, z, size in ((0.40, 0.34, 0.52, 0.13), (0.58, 0.20, 0.47, 0.09)):
        model.add(
            tube([(x * 0.95, y - 0.22, z * 0.95), (x, y, z)], [size * 0.42, size * 0.32]), 0.02, (0.78, 0.72, 0.6)
        )
        cap = ellipsoid((x, y, z), (size, size * 0.75, size))
        model.add(lambda p, cap=cap, y=y: np.maximum(cap(p), y - p[:, 1]), 0.0, red)
        for a in range(5):
            at = (x + size * 0.6 * np.cos(a * 2.4), y + size * 0.5, z + size * 0.6 * np.sin(a * 2.4))
            model.paint(ellipsoid(at, (size * 0.2, size * 0.3, size * 0.2)), (0.8, 0.76, 0.68, 0.6), 0.006)
    model.cut(GROUND)

    def grown(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        result = looks.copy()
        is_bark = (np.abs(looks[:, 0] - bark[0]) < 0.02) & (looks[:, 3] > 0.8)
        down = np.tile(np.array([0.0, 1.0, 0.0]), (len(p), 1))
        grain = strands(p, down, 26, 0.16, seed) + 0.6 * cloud(p, 7, seed + 5)
        top = (normals[:, 1] > 0.9) & (np.hypot(p[:, 0], p[:, 2]) < 0.56) & (p[:, 1] > 0.6)
        radius = np.hypot(p[:, 0] - 0.04, p[:, 2] + 0.03) + 0.02 * cloud(p, 3, seed + 6)
        ring = (radius / 0.035) % 1
        wood = np.array(pale) * (1 - 0.5 * ring[:, None] ** 2) * (1 + 0.15 * cloud(p, 20, seed + 7))[:, None]
        covered = np.clip(3.0 * (cloud(p, 2.6, seed + 8) + 0.75 * normals[:, 1] - 0.40 - 0.3 * p[:, 1]), 0, 1) * 0.9
        rind = looks[:, :3] * (1 + 0.55 * grain)[:, None]
        rind = rind * (1 - covered[:, None]) + moss * (1 + 0.45 * cloud(p, 30, seed + 9, 2))[:, None] * covered[:, None]
        result[is_bark, :3] = rind[is_bark]
        result[top, :3] = wood[top]
        return result

    model.finish = grown
    bounds = ((-1.15, -0.1, -1.15), (1.15, 1.0, 1.15))
    save(
        "stump_butterfly/stump",
        model,
        bounds,
        0.036,
        seed=seed,
        texture=768,
        open_below=0.003,
        scale=2,
        place=(0, 1, 0),
    )


def _between(value: np.ndarray, low: float, high: float, fade: float) -> np.ndarray:
    return np.clip(np.minimum(value - low, high - value) / fade + 0.5, 0, 1)
