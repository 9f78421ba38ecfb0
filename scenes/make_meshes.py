"""Makes the base meshes of the shipped scenes: `python scenes/make_meshes.py [scene ...]`. Same files every time.

Every animal looks along +z. Each scene has units and an origin of its own, as scenes that people bring along have.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from modelling import Model, box, curve, ellipsoid, lathe, mirrored, tube, write_ply

HERE = Path(__file__).resolve().parent
GROUND = box((0, -1, 0), (9, 1, 9), 0.0)


def save(
    name: str,
    model: Model,
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]],
    cell: float,
    scale: float = 1.0,
    place: tuple[float, float, float] = (0, 0, 0),
    coloured: bool = True,
) -> None:
    """Meshes `model` inside `bounds`, scales it, moves it to `place` and writes `scenes/<name>.ply`."""
    surface = model.mesh(*bounds, cell)
    colours = model.colours(np.asarray(surface.vertices, np.float32), 0.6 * cell) if coloured else None
    surface.apply_scale(scale)
    surface.apply_translation(place)
    write_ply(HERE / f"{name}.ply", surface, colours)
    size = ", ".join(f"{a:.2f}..{b:.2f}" for a, b in surface.bounds.T)
    print(f"{name}.ply: {len(surface.vertices)} vertices, {len(surface.faces)} faces, x y z = {size}")


def pegasus() -> None:
    """A horse, 2.4 units tall."""
    coat, mane, hoof, nose = (0.36, 0.17, 0.07), (0.05, 0.028, 0.018), (0.04, 0.033, 0.03), (0.12, 0.06, 0.04)
    horse = Model(coat)
    horse.add(ellipsoid((0, 1.22, -0.02), (0.285, 0.345, 0.70)))
    horse.add(ellipsoid((0, 1.25, 0.44), (0.26, 0.34, 0.30)), 0.15)
    horse.add(ellipsoid((0, 1.30, -0.52), (0.28, 0.33, 0.36)), 0.15)
    horse.add(tube([(0, 1.52, 0.16), (0, 1.56, 0.36)], [0.07, 0.09]), 0.15)
    horse.add(tube([(0, 1.32, 0.48), (0, 1.70, 0.82), (0, 2.03, 1.00)], [0.28, 0.19, 0.14], (1.45, 1, 1)), 0.14)
    # Head: skull, cheek, nose ridge, muzzle with a lip line.
    horse.add(tube([(0, 2.08, 1.04), (0, 1.90, 1.27), (0, 1.70, 1.47)], [0.14, 0.125, 0.085], (1.22, 1, 1)), 0.06)
    horse.add(mirrored(ellipsoid((0.045, 1.90, 1.14), (0.065, 0.15, 0.13), (-40, 0, 0))), 0.05)
    horse.add(tube([(0, 1.68, 1.49), (0, 1.63, 1.53)], [0.088, 0.082], (1.1, 1, 1)), 0.05, nose)
    horse.add(mirrored(ellipsoid((0.052, 1.655, 1.59), (0.022, 0.03, 0.022))), 0.02, nose)
    horse.add(
        mirrored(tube([(0.065, 2.15, 1.02), (0.088, 2.25, 1.04), (0.09, 2.37, 1.05)], [0.05, 0.052, 0.012])), 0.03
    )
    horse.add(mirrored(ellipsoid((0.098, 1.985, 1.22), (0.028, 0.035, 0.035))), 0.01, hoof)
    # Legs: the left ones stand a little further forward than the right ones.
    for side, step in ((1, 0.05), (-1, -0.05)):
        x = side * 0.17
        fore = [(x, 1.15, 0.46), (x, 0.90, 0.42), (x, 0.54, 0.46 + step), (x, 0.18, 0.45 + step)]
        horse.add(tube(fore, [0.17, 0.115, 0.068, 0.05]), 0.10)
        horse.add(ellipsoid((x, 0.53, 0.47 + step), (0.07, 0.09, 0.075)), 0.05)
        horse.add(tube([(x, 0.17, 0.45 + step), (x, 0.09, 0.49 + step)], [0.06, 0.058]), 0.04)
        horse.add(tube([(x, 0.075, 0.50 + step), (x, 0.0, 0.53 + step)], [0.07, 0.095]), 0.0, hoof)
        hind = [(x, 1.22, -0.58), (x * 1.1, 0.93, -0.50), (x * 1.05, 0.58, -0.80 - step), (x, 0.18, -0.74 - step)]
        horse.add(tube(hind, [0.24, 0.155, 0.075, 0.052]), 0.12)
        horse.add(ellipsoid((x * 1.05, 0.59, -0.81 - step), (0.06, 0.09, 0.08)), 0.05)
        horse.add(tube([(x, 0.17, -0.74 - step), (x, 0.09, -0.70 - step)], [0.06, 0.058]), 0.04)
        horse.add(tube([(x, 0.075, -0.69 - step), (x, 0.0, -0.66 - step)], [0.07, 0.095]), 0.0, hoof)
    # Mane: a crest of overlapping locks down the neck, and a forelock; then the tail.
    for t in np.linspace(0, 1, 9):
        y, z = 2.17 - 0.60 * t, 0.97 - 0.58 * t
        horse.add(
            tube([(0, y, z), (0, y - 0.03, z - 0.10), (0, y - 0.15, z - 0.15)], [0.09, 0.075, 0.02], (1.7, 1, 1)),
            0.03,
            mane,
        )
    horse.add(tube([(0, 2.20, 1.02), (0, 2.16, 1.14), (0, 2.02, 1.24)], [0.06, 0.055, 0.015]), 0.02, mane)
    tail = [(0, 1.46, -0.84), (0, 1.45, -0.98), (0, 1.25, -1.10), (0, 0.85, -1.14), (0, 0.48, -1.08)]
    horse.add(tube(*curve(tail, [0.06, 0.075, 0.105, 0.115, 0.02])), 0.04, mane)
    horse.cut(GROUND)
    save("pegasus/horse", horse, ((-0.5, -0.1, -1.35), (0.5, 2.5, 1.75)), 0.0335, place=(1.5, 0, -0.4))


def cat() -> None:
    """A ginger cat with its tail up, 32 units (centimetres) tall."""
    coat, white, dark = (0.60, 0.24, 0.06), (0.80, 0.76, 0.70), (0.30, 0.09, 0.02)
    pink, green, black = (0.60, 0.22, 0.20), (0.25, 0.45, 0.08), (0.01, 0.01, 0.01)
    puss = Model(coat)
    puss.add(tube([(0, 0.50, 0.28), (0, 0.49, -0.05), (0, 0.51, -0.34)], [0.165, 0.17, 0.175]))
    puss.add(ellipsoid((0, 0.50, 0.31), (0.155, 0.19, 0.15)), 0.08)
    puss.add(tube([(0, 0.56, 0.34), (0, 0.72, 0.46)], [0.13, 0.115]), 0.08)
    # Head: broad skull, cheeks, two muzzle pads, chin, triangular ears.
    puss.add(ellipsoid((0, 0.81, 0.52), (0.195, 0.165, 0.165)), 0.05)
    puss.add(mirrored(ellipsoid((0.09, 0.75, 0.57), (0.10, 0.075, 0.09))), 0.05)
    puss.add(mirrored(ellipsoid((0.034, 0.745, 0.67), (0.052, 0.042, 0.045))), 0.02, white)
    puss.add(ellipsoid((0, 0.705, 0.645), (0.045, 0.03, 0.04)), 0.02, white)
    puss.add(ellipsoid((0, 0.785, 0.70), (0.024, 0.017, 0.02)), 0.01, pink)
    puss.add(
        mirrored(
            tube([(0.105, 0.88, 0.50), (0.125, 0.96, 0.50), (0.15, 1.07, 0.49)], [0.085, 0.065, 0.01], (1, 1, 1.7))
        ),
        0.03,
    )
    puss.add(mirrored(ellipsoid((0.078, 0.835, 0.655), (0.036, 0.038, 0.022), (0, 20, 0))), 0.0, green)
    puss.paint(mirrored(ellipsoid((0.083, 0.835, 0.68), (0.011, 0.034, 0.03))), black)
    puss.paint(mirrored(ellipsoid((0.135, 0.97, 0.545), (0.035, 0.07, 0.03), (0, 0, -15))), pink)
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
    puss.paint(ellipsoid((0, 0.47, 0.44), (0.09, 0.17, 0.10)), white)
    for z in (-0.42, -0.30, -0.18, -0.06, 0.06, 0.18):
        puss.paint(box((0, 0.62, z), (0.20, 0.13, 0.018), 0.015, (12, 0, 0)), dark)
    for x in (-0.06, 0.0, 0.06):
        puss.paint(box((x, 0.95, 0.58), (0.014, 0.06, 0.06), 0.01), dark)
    for y, z in ((0.74, -0.70), (0.86, -0.72), (0.97, -0.71)):
        puss.paint(box((0, y, z), (0.1, 0.022, 0.1), 0.01), dark)
    puss.paint(ellipsoid((0, 1.05, -0.62), (0.08, 0.05, 0.08)), dark)
    save("cat/cat", puss, ((-0.35, -0.1, -0.95), (0.35, 1.2, 0.85)), 0.0192, scale=30, place=(-12, 0, 40))


def snowman() -> None:
    """A snowman in four meshes: snow, carrot, twigs, coal. 2.1 units tall, arms 2.6 wide."""
    snow = Model((0.85, 0.88, 0.92))
    for y, radius in ((0.50, 0.56), (1.22, 0.41), (1.80, 0.30)):
        snow.add(ellipsoid((0, y, 0), (radius, radius * 0.97, radius)), 0.06)
    snow.cut(GROUND)
    save("snowman/snow", snow, ((-0.7, -0.1, -0.7), (0.7, 2.3, 0.7)), 0.045, place=(0, -3, 0), coloured=False)

    carrot = Model((0.85, 0.25, 0.03))
    carrot.add(tube([(0, 1.80, 0.24), (0.01, 1.79, 0.45), (0, 1.77, 0.68)], [0.062, 0.042, 0.012]))
    for z, radius in ((0.36, 0.055), (0.44, 0.048), (0.52, 0.038)):
        carrot.add(ellipsoid((0, 1.793, z), (radius, radius, 0.02)), 0.02)
    save("snowman/carrot", carrot, ((-0.1, 1.6, 0.1), (0.1, 1.95, 0.75)), 0.014, place=(0, -3, 0), coloured=False)

    twigs = Model((0.12, 0.06, 0.03))
    twigs.add(
        mirrored(
            tube(
                [(0.33, 1.30, 0.05), (0.72, 1.42, 0.12), (1.05, 1.66, 0.14), (1.30, 1.74, 0.18)],
                [0.036, 0.032, 0.026, 0.014],
            )
        )
    )
    twigs.add(mirrored(tube([(1.03, 1.65, 0.14), (1.12, 1.88, 0.10)], [0.024, 0.012])), 0.02)
    twigs.add(mirrored(tube([(1.03, 1.65, 0.14), (1.28, 1.58, 0.22)], [0.024, 0.012])), 0.02)
    save("snowman/twigs", twigs, ((-1.4, 1.2, -0.1), (1.4, 2.0, 0.35)), 0.014, place=(0, -3, 0), coloured=False)

    coal = Model((0.015, 0.015, 0.017))
    for y, z in ((1.02, 0.36), (1.20, 0.405), (1.38, 0.375)):
        coal.add(ellipsoid((0, y, z), (0.045, 0.045, 0.03)))
    coal.add(mirrored(ellipsoid((0.105, 1.89, 0.258), (0.036, 0.04, 0.03))))
    for angle in np.deg2rad((-50, -25, 0, 25, 50)):
        coal.add(
            ellipsoid(
                (0.16 * np.sin(angle), 1.83 - 0.17 * np.cos(angle), 0.262 - 0.02 * np.sin(angle) ** 2),
                (0.02, 0.02, 0.03),
            )
        )
    save("snowman/coal", coal, ((-0.2, 0.9, 0.1), (0.2, 2.0, 0.5)), 0.01, place=(0, -3, 0), coloured=False)


def mug() -> None:
    """A tall mug without a handle, 12 units (centimetres) tall."""
    glaze, clay = (0.05, 0.20, 0.33), (0.62, 0.48, 0.34)
    cup = Model(glaze)
    wall = [
        (0, 0.02),
        (0.30, 0.02),
        (0.325, 0.10),
        (0.335, 0.5),
        (0.33, 0.98),
        (0.275, 0.98),
        (0.28, 0.5),
        (0.26, 0.12),
        (0, 0.10),
    ]
    cup.add(lathe(wall, 0.018))
    cup.paint(box((0, 0.04, 0), (0.5, 0.08, 0.5), 0.0), clay)
    cup.paint(lathe([(0.31, 0.80), (0.40, 0.80), (0.40, 0.84), (0.31, 0.84)]), clay)
    save("mug/mug", cup, ((-0.45, -0.1, -0.45), (0.45, 1.1, 0.45)), 0.0245, scale=12, place=(5, 0.5, -8))


def skateboard_dog() -> None:
    """A beagle, 0.6 units (metres) tall."""
    coat, white, black, red = (0.42, 0.17, 0.05), (0.78, 0.74, 0.68), (0.02, 0.017, 0.015), (0.55, 0.02, 0.02)
    dog = Model(coat)
    dog.add(tube([(0, 0.63, 0.32), (0, 0.64, 0), (0, 0.65, -0.36)], [0.195, 0.175, 0.17]))
    dog.add(ellipsoid((0, 0.60, 0.36), (0.18, 0.24, 0.18)), 0.08)
    dog.add(tube([(0, 0.72, 0.40), (0, 0.95, 0.55)], [0.15, 0.12]), 0.08)
    # Head: skull, long muzzle, hanging ears.
    dog.add(ellipsoid((0, 1.03, 0.59), (0.155, 0.145, 0.17)), 0.06)
    dog.add(tube([(0, 0.99, 0.70), (0, 0.965, 0.88)], [0.10, 0.078], (1.05, 1, 1)), 0.05, white)
    dog.add(mirrored(ellipsoid((0.05, 0.93, 0.83), (0.045, 0.05, 0.09))), 0.04, white)
    dog.add(ellipsoid((0, 1.015, 0.95), (0.045, 0.036, 0.034)), 0.01, black)
    dog.add(mirrored(ellipsoid((0.068, 1.075, 0.725), (0.027, 0.03, 0.024))), 0.0, black)
    ear = [(0.13, 1.12, 0.55), (0.195, 1.06, 0.56), (0.205, 0.92, 0.59), (0.19, 0.82, 0.60)]
    dog.add(mirrored(tube(*curve(ear, [0.05, 0.09, 0.11, 0.06]), (2.4, 1, 1))), 0.02, (0.22, 0.08, 0.025))
    for side, step in ((1, 0.03), (-1, -0.03)):
        x = side * 0.115
        dog.add(tube([(x, 0.55, 0.34), (x, 0.30, 0.36 + step), (x, 0.06, 0.36 + step)], [0.11, 0.068, 0.06]), 0.08)
        dog.add(ellipsoid((x, 0.045, 0.395 + step), (0.072, 0.06, 0.10)), 0.03)
        hind = [
            (x, 0.60, -0.37),
            (x * 1.15, 0.39, -0.31),
            (x * 1.1, 0.22, -0.50 - step),
            (x * 1.05, 0.06, -0.46 - step),
        ]
        dog.add(tube(hind, [0.17, 0.115, 0.064, 0.058]), 0.08)
        dog.add(ellipsoid((x * 1.05, 0.045, -0.42 - step), (0.072, 0.06, 0.10)), 0.03)
    tail = [(0, 0.76, -0.48), (0, 0.88, -0.64), (0, 1.08, -0.74), (0, 1.22, -0.72)]
    dog.add(tube(*curve(tail, [0.06, 0.052, 0.042, 0.022])), 0.06)
    dog.cut(GROUND)
    dog.paint(ellipsoid((0, 0.72, -0.08), (0.25, 0.16, 0.30)), black)
    dog.paint(ellipsoid((0, 1.12, 0.72), (0.025, 0.12, 0.16)), white)
    dog.paint(ellipsoid((0, 0.52, 0.52), (0.15, 0.28, 0.16)), white)
    dog.paint(box((0, 0.1, 0), (1, 0.16, 2), 0.0), white)
    dog.paint(ellipsoid((0, 1.23, -0.72), (0.09, 0.10, 0.09)), white)
    dog.paint(box((0, 0.845, 0.485), (0.165, 0.022, 0.2), 0.01, (35, 0, 0)), red)
    save(
        "skateboard_dog/dog", dog, ((-0.35, -0.1, -0.95), (0.35, 1.35, 1.1)), 0.0222, scale=0.5, place=(-0.2, 1.0, 0.3)
    )


SCENES = {"pegasus": pegasus, "cat": cat, "snowman": snowman, "mug": mug, "skateboard_dog": skateboard_dog}

if __name__ == "__main__":
    for scene in sys.argv[1:] or SCENES:
        SCENES[scene]()
