"""The deer and the bronze bull. Both look along +z."""

from __future__ import annotations

import numpy as np

from models.equines import GROUND
from models.files import save
from models.finishes import fur, patina, standing_coat
from models.model import Model
from models.pets import GLINT, GLOSS
from models.shapes import box, curve, ellipsoid, mirrored, moved, torus, tube


def deer(seed: int) -> None:
    """A fallow deer without antlers: spots, white belly and rump. 1.5 units tall, 2 long."""
    coat, white, dark = (0.38, 0.17, 0.06), (0.78, 0.72, 0.62), (0.05, 0.03, 0.022)
    model = Model(coat)
    add = model.add
    add(ellipsoid((0, 0.95, -0.02), (0.215, 0.25, 0.56)))
    add(ellipsoid((0, 0.94, 0.36), (0.19, 0.265, 0.25)), 0.12)
    add(ellipsoid((0, 0.99, -0.40), (0.21, 0.24, 0.27)), 0.12)
    add(tube([(0, 1.0, 0.46), (0, 1.20, 0.70), (0, 1.34, 0.84)], [0.20, 0.125, 0.10], (1.3, 1, 1)), 0.12)
    add(tube([(0, 1.375, 0.87), (0, 1.32, 1.03), (0, 1.24, 1.19)], [0.13, 0.105, 0.062], (1.1, 1, 1)), 0.05)
    add(mirrored(ellipsoid((0.05, 1.30, 0.95), (0.06, 0.08, 0.10))), 0.04)
    add(ellipsoid((0, 1.225, 1.225), (0.052, 0.045, 0.04)), 0.02, (*dark, 0.25))
    ear = [(0.07, 1.44, 0.83), (0.20, 1.50, 0.80), (0.34, 1.52, 0.78)]
    add(mirrored(tube(*curve(ear, [0.05, 0.08, 0.015]), (1, 1, 1.9))), 0.02)
    add(mirrored(ellipsoid((0.088, 1.375, 0.985), (0.032, 0.042, 0.045))), 0.0, GLOSS)
    for side, step in ((1, 0.05), (-1, -0.05)):
        x = side * 0.12
        fore = [(x, 0.90, 0.36), (x, 0.62, 0.34), (x, 0.37, 0.36 + step), (x, 0.07, 0.35 + step)]
        add(tube(fore, [0.14, 0.075, 0.048, 0.038]), 0.08)
        add(tube([(x, 0.055, 0.36 + step), (x, 0.0, 0.395 + step)], [0.045, 0.06]), 0.01, dark)
        hind = [(x, 0.95, -0.44), (x * 1.1, 0.70, -0.36), (x * 1.05, 0.43, -0.58 - step), (x, 0.08, -0.53 - step)]
        add(tube(hind, [0.19, 0.115, 0.053, 0.04]), 0.09)
        add(tube([(x, 0.055, -0.52 - step), (x, 0.0, -0.485 - step)], [0.045, 0.06]), 0.01, dark)
    add(tube([(0, 1.11, -0.62), (0, 1.06, -0.72), (0, 0.93, -0.75)], [0.06, 0.065, 0.02], (1, 1, 1.4)), 0.04)
    model.cut(GROUND)
    model.paint(ellipsoid((0, 0.69, -0.05), (0.19, 0.11, 0.62)), white, 0.06)
    model.paint(ellipsoid((0, 0.95, -0.66), (0.15, 0.17, 0.10)), white, 0.04)
    model.paint(tube([(0, 1.05, 0.72), (0, 1.22, 0.94)], [0.06, 0.05]), white, 0.04)
    model.paint(ellipsoid((0, 1.17, 1.15), (0.06, 0.05, 0.10)), white, 0.03)
    model.paint(mirrored(ellipsoid((0.095, 1.375, 0.985), (0.045, 0.05, 0.056))), (0.62, 0.45, 0.30), 0.015)
    model.paint(mirrored(ellipsoid((0.088, 1.375, 0.985), (0.045, 0.048, 0.052))), GLOSS, 0.004)
    model.paint(mirrored(ellipsoid((0.12, 1.392, 1.0), (0.012, 0.01, 0.012))), GLINT, 0.003)
    model.paint(mirrored(tube([(0.16, 1.485, 0.86), (0.28, 1.515, 0.83)], [0.035, 0.025])), (0.70, 0.52, 0.42), 0.015)
    model.paint(tube([(0, 1.26, -0.5), (0, 1.22, 0.3), (0, 1.42, 0.68)], [0.045] * 3), (0.16, 0.06, 0.02), 0.07)
    spots = np.random.default_rng(5)
    for row, y in enumerate((1.12, 1.04, 0.95)):
        for z in np.arange(-0.52, 0.34, 0.105):
            at = (0.19, y + spots.uniform(-0.015, 0.015), z + 0.05 * (row % 2) + spots.uniform(-0.015, 0.015))
            model.paint(mirrored(ellipsoid(at, (0.1, 0.022, 0.026))), white, 0.01)
    model.finish = fur(lambda p: standing_coat(p, 0.78, (0.5, 0.3)), 0.035, 0.28)
    bounds = ((-0.45, -0.1, -0.95), (0.45, 1.7, 1.4))
    save("deer/deer", model, bounds, 0.0275, seed=seed, texture=768, place=(0, 0, 3))


def bronze_bull(seed: int) -> None:
    """A bronze bull without horns, 1.7 units tall, 2.9 long."""
    model, body = Model((0.62, 0.33, 0.12), 0.22), Model((0.62, 0.33, 0.12))
    add = body.add
    add(ellipsoid((0, 1.02, -0.15), (0.38, 0.36, 0.85)))
    add(ellipsoid((0, 1.13, 0.40), (0.37, 0.46, 0.40)), 0.2)
    add(ellipsoid((0, 1.07, -0.76), (0.35, 0.34, 0.32)), 0.12)
    add(tube([(0, 1.18, 0.62), (0, 1.24, 0.98)], [0.37, 0.26], (1.2, 1, 1)), 0.15)
    add(tube([(0, 0.72, 0.58), (0, 0.80, 0.86), (0, 1.02, 1.14)], [0.15, 0.13, 0.08], (2.2, 1, 1)), 0.08)
    # Head: broad brow, long face, muzzle with nostrils and a ring through the nose.
    add(tube([(0, 1.30, 1.05), (0, 1.12, 1.26), (0, 0.99, 1.37)], [0.25, 0.20, 0.165], (1.0, 1, 1)), 0.06)
    add(ellipsoid((0, 1.45, 1.02), (0.21, 0.10, 0.13)), 0.05)
    add(ellipsoid((0, 0.95, 1.40), (0.19, 0.13, 0.11)), 0.04)
    body.cut(mirrored(ellipsoid((0.095, 0.99, 1.50), (0.042, 0.032, 0.04))))
    body.cut(box((0, 0.885, 1.48), (0.14, 0.014, 0.06), 0.005))
    add(torus((0, 0.87, 1.52), 0.07, 0.028, (70, 0, 0)))
    add(mirrored(tube([(0.1, 1.36, 1.2), (0.215, 1.34, 1.14)], [0.06, 0.05])), 0.03)
    add(mirrored(ellipsoid((0.195, 1.27, 1.185), (0.045, 0.05, 0.055))), 0.0)
    ear = [(0.20, 1.36, 0.98), (0.38, 1.36, 0.93), (0.54, 1.25, 0.93)]
    add(mirrored(tube(*curve(ear, [0.055, 0.10, 0.025]), (1, 1, 1.8))), 0.02)
    for x, y, z in ((0, 1.50, 1.10), (-0.1, 1.47, 1.11), (0.1, 1.47, 1.11), (0.05, 1.40, 1.22), (-0.05, 1.40, 1.22)):
        add(ellipsoid((x, y, z), (0.07, 0.07, 0.07)), 0.01)
    model.add(moved(body.distance, (0, 0.14, 0)))
    add = model.add
    for side, step in ((1, 0.08), (-1, -0.08)):
        x = side * 0.23
        fore = [(x, 1.10, 0.48), (x, 0.70, 0.46 + step), (x, 0.50, 0.50 + step), (x, 0.14, 0.48 + step)]
        add(tube(fore, [0.24, 0.14, 0.115, 0.08]), 0.10)
        add(tube([(x, 0.09, 0.51 + step), (x, 0.0, 0.55 + step)], [0.10, 0.125]), 0.03)
        hind = [(x, 1.15, -0.80), (x * 1.05, 0.78, -0.68), (x, 0.52, -0.94 - step), (x, 0.14, -0.84 - step)]
        add(tube(hind, [0.28, 0.18, 0.095, 0.08]), 0.12)
        add(tube([(x, 0.09, -0.81 - step), (x, 0.0, -0.77 - step)], [0.10, 0.125]), 0.03)
        for z in (0.64 + step, -0.68 - step):
            model.cut(box((x, 0.05, z), (0.012, 0.12, 0.07), 0.0))
    tail = [(0, 1.42, -0.98), (0, 1.44, -1.13), (0, 1.12, -1.22), (0, 0.74, -1.2)]
    add(tube(*curve(tail, [0.06, 0.055, 0.045, 0.045])), 0.06)
    add(tube([(0, 0.74, -1.2), (0, 0.56, -1.21), (0, 0.40, -1.18)], [0.05, 0.10, 0.02]), 0.03)
    model.cut(GROUND)
    model.paint(mirrored(ellipsoid((0.22, 1.41, 1.19), (0.035, 0.035, 0.04))), (0.10, 0.05, 0.02, 0.3), 0.01)
    model.finish = patina((0.07, 0.13, 0.10), 0.28)
    bounds = ((-0.65, -0.1, -1.45), (0.65, 1.85, 1.85))
    save("bronze_bull/bull", model, bounds, 0.041, seed=seed, scale=0.4, place=(2, 0, 1))
