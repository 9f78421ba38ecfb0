"""The cat, the dog of `skateboard_dog`, and the rabbit of `rabbit_glasses`. All look along +z."""

from __future__ import annotations

import numpy as np

from models.equines import GROUND
from models.files import save
from models.finishes import fur, standing_coat
from models.model import Model
from models.shapes import box, curve, ellipsoid, mirrored, tube

GLOSS = (0.008, 0.007, 0.006, 0.1)
GLINT = (0.9, 0.9, 0.9, 0.1)


def cat(seed: int) -> None:
    """A ginger cat with its tail up, 32 units (centimetres) tall."""
    coat, white, dark = (0.62, 0.25, 0.06), (0.80, 0.76, 0.70), (0.27, 0.075, 0.015)
    pink, green = (0.60, 0.22, 0.20), (0.28, 0.50, 0.06, 0.1)
    puss = Model(coat)
    puss.add(tube([(0, 0.50, 0.28), (0, 0.49, -0.05), (0, 0.51, -0.34)], [0.165, 0.17, 0.175]))
    puss.add(ellipsoid((0, 0.50, 0.31), (0.155, 0.19, 0.15)), 0.08)
    puss.add(tube([(0, 0.56, 0.34), (0, 0.72, 0.46)], [0.13, 0.115]), 0.08)
    # Head: broad skull, cheeks, two muzzle pads, chin, triangular ears.
    puss.add(ellipsoid((0, 0.81, 0.52), (0.195, 0.165, 0.165)), 0.05)
    puss.add(mirrored(ellipsoid((0.09, 0.75, 0.57), (0.10, 0.075, 0.09))), 0.05)
    puss.add(mirrored(ellipsoid((0.034, 0.745, 0.67), (0.052, 0.042, 0.045))), 0.02, white)
    puss.add(ellipsoid((0, 0.705, 0.645), (0.045, 0.03, 0.04)), 0.02, white)
    puss.add(ellipsoid((0, 0.785, 0.70), (0.024, 0.017, 0.02)), 0.01, (*pink, 0.35))
    ear = tube([(0.105, 0.88, 0.50), (0.125, 0.96, 0.50), (0.15, 1.07, 0.49)], [0.085, 0.065, 0.01], (1, 1, 1.7))
    puss.add(mirrored(ear), 0.03)
    puss.add(mirrored(ellipsoid((0.078, 0.835, 0.655), (0.036, 0.038, 0.022), (0, 20, 0))), 0.0, green)
    for side, step in ((1, 0.03), (-1, -0.03)):
        x = side * 0.095
        puss.add(tube([(x, 0.46, 0.29), (x, 0.24, 0.31 + step), (x, 0.05, 0.31 + step)], [0.09, 0.062, 0.052]), 0.06)
        puss.add(ellipsoid((x, 0.04, 0.335 + step), (0.062, 0.05, 0.085)), 0.03, white)
        hind = [(x, 0.47, -0.33), (x * 1.2, 0.31, -0.27), (x * 1.15, 0.18, -0.43 - step), (x * 1.1, 0.05, -0.40 - step)]
        puss.add(tube(hind, [0.155, 0.105, 0.06, 0.052]), 0.06)
        puss.add(ellipsoid((x * 1.1, 0.04, -0.365 - step), (0.062, 0.05, 0.085)), 0.03, white)
    tail = [(0, 0.56, -0.46), (0, 0.62, -0.62), (0, 0.78, -0.72), (0, 0.96, -0.72), (0, 1.05, -0.64)]
    puss.add(tube(*curve(tail, [0.06, 0.055, 0.052, 0.048, 0.036])), 0.06)
    puss.cut(GROUND)
    puss.paint(ellipsoid((0, 0.47, 0.44), (0.09, 0.17, 0.10)), white, 0.03)
    for z in (-0.42, -0.30, -0.18, -0.06, 0.06, 0.18):
        puss.paint(box((0, 0.62, z), (0.20, 0.13, 0.018), 0.015, (12, 0, 0)), dark, 0.015)
    for y, z in ((0.34, -0.33), (0.25, -0.33)):
        puss.paint(box((0, y, z), (0.3, 0.012, 0.16), 0.01, (20, 0, 0)), dark, 0.015)
    for x in (-0.06, 0.0, 0.06):
        puss.paint(box((x, 0.95, 0.58), (0.012, 0.06, 0.06), 0.01), dark, 0.01)
    for y in (0.77, 0.72):
        puss.paint(mirrored(box((0.19, y, 0.56), (0.05, 0.011, 0.06), 0.01, (0, 0, -12))), dark, 0.01)
    for y, z in ((0.74, -0.70), (0.86, -0.72), (0.97, -0.71)):
        puss.paint(box((0, y, z), (0.1, 0.022, 0.1), 0.01), dark, 0.015)
    puss.paint(ellipsoid((0, 1.05, -0.62), (0.08, 0.05, 0.08)), dark, 0.02)
    puss.paint(mirrored(ellipsoid((0.083, 0.835, 0.68), (0.012, 0.032, 0.03))), GLOSS, 0.004)
    puss.paint(mirrored(ellipsoid((0.092, 0.85, 0.685), (0.008, 0.008, 0.03))), GLINT, 0.003)
    puss.paint(mirrored(ellipsoid((0.135, 0.97, 0.545), (0.035, 0.07, 0.03), (0, 0, -15))), pink, 0.015)
    puss.paint(box((0, 0.745, 0.71), (0.004, 0.03, 0.03), 0.0), (0.12, 0.04, 0.035), 0.004)
    puss.finish = fur(lambda p: standing_coat(p, 0.4, (0.3, 0.2)), 0.03, 0.28)
    bounds = ((-0.35, -0.1, -0.95), (0.35, 1.2, 0.85))
    save("cat/cat", puss, bounds, 0.0205, seed=seed, texture=768, scale=30, place=(-12, 0, 40))


def skateboard_dog(seed: int) -> None:
    """A beagle, 0.6 units (metres) tall."""
    coat, white, black, red = (0.42, 0.17, 0.05), (0.78, 0.74, 0.68), (0.02, 0.017, 0.015), (0.55, 0.02, 0.02)
    ears = (0.20, 0.07, 0.022)
    dog = Model(coat)
    dog.add(tube([(0, 0.63, 0.32), (0, 0.64, 0), (0, 0.65, -0.36)], [0.195, 0.175, 0.17]))
    dog.add(ellipsoid((0, 0.60, 0.36), (0.18, 0.24, 0.18)), 0.08)
    dog.add(tube([(0, 0.72, 0.40), (0, 0.95, 0.55)], [0.15, 0.12]), 0.08)
    # Head: skull, long muzzle, hanging ears.
    dog.add(ellipsoid((0, 1.03, 0.59), (0.155, 0.145, 0.17)), 0.06)
    dog.add(tube([(0, 0.99, 0.70), (0, 0.965, 0.88)], [0.10, 0.078], (1.05, 1, 1)), 0.05, white)
    dog.add(mirrored(ellipsoid((0.05, 0.93, 0.83), (0.045, 0.05, 0.09))), 0.04, white)
    dog.add(ellipsoid((0, 1.015, 0.95), (0.045, 0.036, 0.034)), 0.01, (*black, 0.25))
    dog.add(mirrored(ellipsoid((0.068, 1.075, 0.725), (0.03, 0.034, 0.026))), 0.0, GLOSS)
    ear = [(0.13, 1.12, 0.55), (0.195, 1.06, 0.56), (0.205, 0.92, 0.59), (0.19, 0.82, 0.60)]
    dog.add(mirrored(tube(*curve(ear, [0.05, 0.09, 0.11, 0.06]), (2.4, 1, 1))), 0.02, ears)
    for side, step in ((1, 0.03), (-1, -0.03)):
        x = side * 0.115
        dog.add(tube([(x, 0.55, 0.34), (x, 0.30, 0.36 + step), (x, 0.06, 0.36 + step)], [0.11, 0.068, 0.06]), 0.08)
        dog.add(ellipsoid((x, 0.045, 0.395 + step), (0.072, 0.06, 0.10)), 0.03)
        knee, hock, heel = (x * 1.15, 0.39, -0.31), (x * 1.1, 0.22, -0.50 - step), (x * 1.05, 0.06, -0.46 - step)
        dog.add(tube([(x, 0.60, -0.37), knee, hock, heel], [0.17, 0.115, 0.064, 0.058]), 0.08)
        dog.add(ellipsoid((x * 1.05, 0.045, -0.42 - step), (0.072, 0.06, 0.10)), 0.03)
    tail = [(0, 0.76, -0.48), (0, 0.88, -0.64), (0, 1.08, -0.74), (0, 1.22, -0.72)]
    dog.add(tube(*curve(tail, [0.06, 0.052, 0.042, 0.022])), 0.06)
    dog.cut(GROUND)
    dog.paint(ellipsoid((0, 0.72, -0.08), (0.25, 0.16, 0.30)), black, 0.05)
    dog.paint(ellipsoid((0, 1.12, 0.72), (0.025, 0.12, 0.16)), white, 0.02)
    dog.paint(ellipsoid((0, 0.52, 0.52), (0.15, 0.28, 0.16)), white, 0.04)
    dog.paint(box((0, 0.1, 0), (1, 0.16, 2), 0.0), white, 0.04)
    dog.paint(ellipsoid((0, 1.23, -0.72), (0.09, 0.10, 0.09)), white, 0.03)
    dog.paint(box((0, 0.845, 0.485), (0.165, 0.022, 0.2), 0.01, (35, 0, 0)), (*red, 0.3), 0.006)
    dog.paint(ellipsoid((0, 0.80, 0.66), (0.03, 0.035, 0.06)), (0.75, 0.55, 0.12, 0.2), 0.006)
    dog.paint(box((0, 0.925, 0.9), (0.12, 0.005, 0.1), 0.0, (8, 0, 0)), (0.06, 0.03, 0.025), 0.005)
    dog.paint(mirrored(ellipsoid((0.076, 1.088, 0.745), (0.009, 0.009, 0.012))), GLINT, 0.003)
    for x in (0.09, 0.14):
        for z in (0.49, -0.33):
            dog.paint(mirrored(box((x, 0.0, z), (0.004, 0.06, 0.03), 0.0)), (0.1, 0.08, 0.07), 0.005)
    dog.finish = fur(lambda p: standing_coat(p, 0.5, (0.35, 0.2)), 0.03, 0.28)
    bounds = ((-0.35, -0.1, -0.95), (0.35, 1.35, 1.1))
    save("skateboard_dog/dog", dog, bounds, 0.0237, seed=seed, texture=768, scale=0.5, place=(-0.2, 1.0, 0.3))


def rabbit(seed: int) -> None:
    """A sitting rabbit with upright ears, 1.8 units tall."""
    coat, white, pink = (0.36, 0.26, 0.18), (0.80, 0.77, 0.72), (0.66, 0.33, 0.30)
    bunny = Model(coat)
    bunny.add(ellipsoid((0, 0.44, -0.10), (0.35, 0.42, 0.42)))
    bunny.add(ellipsoid((0, 0.56, 0.12), (0.25, 0.32, 0.22)), 0.10)
    bunny.add(ellipsoid((0, 0.99, 0.19), (0.275, 0.245, 0.27)), 0.08)
    bunny.add(mirrored(ellipsoid((0.14, 0.90, 0.31), (0.13, 0.115, 0.13))), 0.06)
    bunny.add(mirrored(ellipsoid((0.05, 0.90, 0.45), (0.075, 0.06, 0.055))), 0.03, white)
    bunny.add(ellipsoid((0, 0.84, 0.42), (0.055, 0.045, 0.05)), 0.02, white)
    bunny.add(ellipsoid((0, 0.955, 0.49), (0.034, 0.024, 0.025)), 0.01, (*pink, 0.35))
    bunny.add(mirrored(ellipsoid((0.155, 1.035, 0.385), (0.06, 0.07, 0.045), (0, 28, 0))), 0.0, GLOSS)
    ear = [(0.09, 1.16, 0.12), (0.14, 1.38, 0.06), (0.19, 1.60, 0.02), (0.215, 1.80, -0.02)]
    bunny.add(mirrored(tube(*curve(ear, [0.07, 0.095, 0.105, 0.025]), (1, 1, 1.9))), 0.03)
    bunny.add(mirrored(ellipsoid((0.27, 0.30, -0.12), (0.20, 0.30, 0.33))), 0.06)
    bunny.add(mirrored(ellipsoid((0.27, 0.08, 0.17), (0.11, 0.085, 0.28))), 0.04)
    bunny.add(mirrored(tube([(0.14, 0.52, 0.20), (0.13, 0.16, 0.33), (0.13, 0.07, 0.38)], [0.11, 0.075, 0.08])), 0.05)
    bunny.add(ellipsoid((0, 0.24, -0.53), (0.14, 0.14, 0.13)), 0.03, white)
    bunny.cut(GROUND)
    bunny.paint(ellipsoid((0, 0.50, 0.30), (0.17, 0.30, 0.20)), white, 0.06)
    bunny.paint(mirrored(ellipsoid((0.155, 1.035, 0.40), (0.085, 0.095, 0.05), (0, 28, 0))), white, 0.02)
    bunny.paint(mirrored(ellipsoid((0.155, 1.035, 0.40), (0.058, 0.068, 0.09), (0, 28, 0))), GLOSS, 0.006)
    bunny.paint(mirrored(ellipsoid((0.168, 1.06, 0.43), (0.014, 0.016, 0.03))), GLINT, 0.004)
    inner = [(0.14, 1.34, 0.12), (0.19, 1.58, 0.085), (0.208, 1.70, 0.05)]
    bunny.paint(mirrored(tube(*curve(inner, [0.035, 0.05, 0.02]))), pink, 0.02)
    bunny.paint(ellipsoid((0, 0.03, 0.3), (0.5, 0.07, 0.3)), white, 0.05)
    bunny.paint(box((0, 0.895, 0.5), (0.005, 0.05, 0.05), 0.0), (0.16, 0.07, 0.06), 0.005)
    bunny.paint(box((0, 0.862, 0.48), (0.05, 0.005, 0.05), 0.0), (0.16, 0.07, 0.06), 0.005)

    def lie(p: np.ndarray) -> np.ndarray:
        upper = np.clip((p[:, 1] - 1.1) / 0.1, 0, 1)  # ears: hair grows towards the tip
        return np.column_stack([0.3 * p[:, 0], 2 * upper - 0.8, -0.6 * (1 - upper)])

    bunny.finish = fur(lie, 0.04, 0.32)
    bounds = ((-0.6, -0.1, -0.75), (0.6, 1.95, 0.65))
    save("rabbit_glasses/rabbit", bunny, bounds, 0.034, seed=seed, texture=768, scale=20, place=(0, 5, 0))
