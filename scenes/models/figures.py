"""The snowman, the person of `superhero`, and the teddy bear. All look along +z."""

from __future__ import annotations

import numpy as np

from models.equines import GROUND
from models.files import save, save_region
from models.finishes import mottled, plush
from models.model import Model
from models.pets import GLINT, GLOSS
from models.shapes import box, ellipsoid, mirrored, torus, tube


def snowman(seed: int) -> None:
    """A snowman in four meshes: snow (colours at its vertices), carrot (texture), twigs and coal (one colour each)."""
    place = (0, -3, 0)
    snow = Model((0.86, 0.89, 0.93))
    for y, radius in ((0.50, 0.56), (1.22, 0.41), (1.80, 0.30)):
        snow.add(ellipsoid((0, y, 0), (radius, radius * 0.97, radius)), 0.06)
    snow.cut(GROUND)
    snow.paint(ellipsoid((0, 0, 0), (0.8, 0.16, 0.8)), (0.62, 0.66, 0.72), 0.2)
    snow.finish = mottled(0.35, 0.07, 0.05)
    bounds = ((-0.7, -0.1, -0.7), (0.7, 2.3, 0.7))
    save("snowman/snow", snow, bounds, 0.045, seed=seed, texture=0, place=place, paint_vertices=True)

    carrot = Model((0.85, 0.25, 0.03), 0.5)
    carrot.add(tube([(0, 1.80, 0.24), (0.01, 1.79, 0.45), (0, 1.77, 0.68)], [0.062, 0.042, 0.012]))
    for z, radius in ((0.36, 0.055), (0.44, 0.048), (0.52, 0.038)):
        carrot.add(ellipsoid((0, 1.793, z), (radius, radius, 0.02)), 0.02)
    for z in np.arange(0.27, 0.66, 0.045):
        carrot.paint(box((0, 1.79 + 0.02 * np.sin(90 * z), z), (0.1, 0.035, 0.0025), 0.0), (0.45, 0.10, 0.01), 0.008)
    carrot.finish = mottled(0.12, 0.18, 0.08)
    save("snowman/carrot", carrot, ((-0.1, 1.6, 0.1), (0.1, 1.95, 0.75)), 0.014, seed=seed, texture=512, place=place)

    twigs = Model((0.12, 0.06, 0.03))
    arm = [(0.33, 1.30, 0.05), (0.72, 1.42, 0.12), (1.05, 1.66, 0.14), (1.30, 1.74, 0.18)]
    twigs.add(mirrored(tube(arm, [0.036, 0.032, 0.026, 0.014])))
    twigs.add(mirrored(tube([(1.03, 1.65, 0.14), (1.12, 1.88, 0.10)], [0.024, 0.012])), 0.02)
    twigs.add(mirrored(tube([(1.03, 1.65, 0.14), (1.28, 1.58, 0.22)], [0.024, 0.012])), 0.02)
    save("snowman/twigs", twigs, ((-1.4, 1.2, -0.1), (1.4, 2.0, 0.35)), 0.016, seed=seed, texture=0, place=place)

    coal = Model((0.015, 0.015, 0.017))
    for y, z in ((1.02, 0.36), (1.20, 0.405), (1.38, 0.375)):
        coal.add(ellipsoid((0, y, z), (0.045, 0.045, 0.03)))
    coal.add(mirrored(ellipsoid((0.105, 1.89, 0.258), (0.036, 0.04, 0.03))))
    for angle in np.deg2rad((-50, -25, 0, 25, 50)):
        at = (0.16 * np.sin(angle), 1.83 - 0.17 * np.cos(angle), 0.262 - 0.02 * np.sin(angle) ** 2)
        coal.add(ellipsoid(at, (0.02, 0.02, 0.03)))
    save("snowman/coal", coal, ((-0.2, 0.9, 0.1), (0.2, 2.0, 0.5)), 0.011, seed=seed, texture=0, place=place)


def superhero(seed: int) -> None:
    """A toy superhero with hands on hips, 1.95 units tall, and the region of the cape as a mesh."""
    blue, red, gold = (0.03, 0.09, 0.42), (0.55, 0.02, 0.02, 0.3), (0.80, 0.50, 0.05, 0.25)
    skin, hair = (0.60, 0.33, 0.22, 0.5), (0.035, 0.018, 0.012, 0.4)
    model = Model(blue, 0.55)
    add = model.add
    add(ellipsoid((0, 0.90, 0), (0.20, 0.15, 0.14)))
    add(tube([(0, 0.95, 0), (0, 1.15, 0.01), (0, 1.34, 0)], [0.165, 0.18, 0.21], (1, 1, 1.35)), 0.08)
    add(mirrored(ellipsoid((0.095, 1.31, 0.085), (0.13, 0.105, 0.085))), 0.05)
    add(mirrored(ellipsoid((0.265, 1.40, 0), (0.115, 0.105, 0.105))), 0.06)
    add(tube([(0, 1.42, 0), (0, 1.56, 0.01)], [0.09, 0.08]), 0.04, skin)
    add(mirrored(tube([(0.28, 1.38, 0), (0.46, 1.14, -0.03), (0.27, 0.98, 0.08)], [0.09, 0.078, 0.058])), 0.03)
    add(mirrored(tube([(0.335, 1.035, 0.045), (0.27, 0.98, 0.08)], [0.074, 0.07])), 0.01, red)
    add(mirrored(ellipsoid((0.235, 0.965, 0.095), (0.075, 0.075, 0.07))), 0.02, red)
    add(mirrored(tube([(0.12, 0.86, 0), (0.155, 0.47, 0.02), (0.18, 0.12, 0)], [0.135, 0.098, 0.075])), 0.06)
    add(mirrored(tube([(0.16, 0.40, 0.02), (0.18, 0.12, 0)], [0.105, 0.085])), 0.01, red)
    add(mirrored(ellipsoid((0.185, 0.06, 0.07), (0.09, 0.075, 0.17))), 0.03, red)
    # Head: skull, jaw, nose, ears, then hair with a quiff.
    add(ellipsoid((0, 1.74, 0.02), (0.165, 0.19, 0.18)), 0.02, skin)
    add(ellipsoid((0, 1.64, 0.06), (0.115, 0.10, 0.12)), 0.05, skin)
    add(tube([(0, 1.75, 0.20), (0, 1.70, 0.225)], [0.02, 0.032]), 0.02, skin)
    add(mirrored(ellipsoid((0.17, 1.72, 0.02), (0.025, 0.05, 0.035))), 0.01, skin)
    add(ellipsoid((0, 1.79, -0.03), (0.18, 0.175, 0.175)), 0.0, hair)
    add(tube([(-0.09, 1.90, 0.13), (0.03, 1.94, 0.15), (0.11, 1.89, 0.12)], [0.05, 0.065, 0.04]), 0.02, hair)
    model.cut(GROUND)
    model.paint(ellipsoid((0, 0.83, 0), (0.24, 0.13, 0.2)), red, 0.008)
    model.paint(mirrored(box((0.17, 0.72, 0), (0.06, 0.09, 0.2), 0.0, (0, 0, 35))), (*blue, 0.55), 0.008)
    model.paint(box((0, 0.975, 0), (0.24, 0.03, 0.3), 0.0), gold, 0.008)
    model.paint(ellipsoid((0, 0.975, 0.18), (0.05, 0.05, 0.1)), (0.9, 0.75, 0.3, 0.2), 0.006)
    model.paint(
        tube([(-0.085, 1.37, 0.2), (0.085, 1.37, 0.2), (0, 1.24, 0.2), (-0.085, 1.37, 0.2)], [0.03] * 4), gold, 0.006
    )
    model.paint(ellipsoid((0, 1.335, 0.2), (0.06, 0.03, 0.2)), red, 0.006)
    model.paint(ellipsoid((0, 1.65, 0.11), (0.16, 0.125, 0.16)), skin, 0.02)
    mask = (0.02, 0.02, 0.02, 0.4)
    model.paint(mirrored(ellipsoid((0.07, 1.77, 0.18), (0.085, 0.045, 0.08), (0, 0, 12))), mask, 0.008)
    model.paint(mirrored(ellipsoid((0.066, 1.77, 0.2), (0.034, 0.02, 0.06), (0, 0, 12))), (0.9, 0.9, 0.9, 0.3), 0.005)
    model.paint(mirrored(ellipsoid((0.062, 1.77, 0.2), (0.012, 0.016, 0.06))), GLOSS, 0.004)
    model.paint(box((0, 1.625, 0.2), (0.05, 0.008, 0.06), 0.0), (0.35, 0.08, 0.06, 0.4), 0.006)
    model.finish = mottled(0.3, 0.05, 0.06)
    bounds = ((-0.7, -0.1, -0.35), (0.7, 2.1, 0.4))
    save("superhero/superhero", model, bounds, 0.0265, seed=seed, texture=768, scale=10)
    cape = Model(red)
    cape.add(tube([(0, 1.24, -0.17), (0, 0.85, -0.28), (0, 0.48, -0.40)], [0.31, 0.38, 0.44], (1, 1, 2.3)))
    save_region("superhero/cape_region", cape, ((-0.6, -0.1, -0.7), (0.6, 1.7, 0.1)), 0.05, 10, (0, 0, 0))


def teddy(seed: int) -> None:
    """A sitting teddy bear, 1.5 units tall."""
    coat, pale, thread = (0.40, 0.20, 0.075), (0.66, 0.47, 0.28), (0.05, 0.025, 0.015)
    bear = Model(coat, 0.9)
    add = bear.add
    add(ellipsoid((0, 0.50, 0), (0.36, 0.43, 0.32)))
    add(ellipsoid((0, 1.10, 0.04), (0.37, 0.33, 0.33)), 0.05)
    add(ellipsoid((0, 1.00, 0.33), (0.17, 0.135, 0.14)), 0.03, pale)
    add(ellipsoid((0, 1.055, 0.46), (0.065, 0.045, 0.04)), 0.01, (0.02, 0.013, 0.01, 0.25))
    add(mirrored(ellipsoid((0.145, 1.18, 0.335), (0.043, 0.046, 0.035))), 0.0, GLOSS)
    add(mirrored(ellipsoid((0.29, 1.38, 0.02), (0.14, 0.14, 0.075), (0, 0, -30))), 0.03)
    add(mirrored(tube([(0.30, 0.76, 0.03), (0.45, 0.55, 0.16), (0.47, 0.44, 0.30)], [0.12, 0.12, 0.125])), 0.03)
    add(mirrored(tube([(0.20, 0.18, 0.10), (0.30, 0.175, 0.46)], [0.18, 0.16])), 0.04)
    add(mirrored(ellipsoid((0.31, 0.21, 0.54), (0.165, 0.20, 0.10))), 0.03)
    add(ellipsoid((0, 0.20, -0.26), (0.09, 0.09, 0.08)), 0.02)
    add(torus((0, 0.84, 0.02), 0.235, 0.062), 0.0, (0.45, 0.02, 0.03, 0.6))
    bear.cut(GROUND)
    bear.paint(mirrored(ellipsoid((0.315, 0.21, 0.64), (0.11, 0.14, 0.06))), pale, 0.012)
    bear.paint(mirrored(ellipsoid((0.295, 1.385, 0.10), (0.085, 0.085, 0.06), (0, 0, -30))), pale, 0.012)
    bear.paint(ellipsoid((0, 0.50, 0.36), (0.20, 0.26, 0.18)), pale, 0.012)
    bear.paint(box((0, 0.98, 0.46), (0.007, 0.045, 0.08), 0.0), thread, 0.006)
    bear.paint(mirrored(tube([(0, 0.935, 0.45), (0.075, 0.955, 0.44)], [0.009, 0.009], (1, 1, 0.2))), thread, 0.006)
    bear.paint(box((0, 1.3, 0.2), (0.005, 0.2, 0.3), 0.0), thread, 0.006)
    bear.paint(mirrored(ellipsoid((0.16, 1.198, 0.37), (0.011, 0.012, 0.01))), GLINT, 0.003)
    bear.finish = plush(0.05, 0.4)
    bounds = ((-0.75, -0.1, -0.55), (0.75, 1.65, 0.8))
    save("teddy_backpack/teddy", bear, bounds, 0.033, seed=seed, texture=768, scale=0.2, place=(0, 0, 0))
