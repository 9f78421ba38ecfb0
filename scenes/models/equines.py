"""The horse of `pegasus`, the pony of `unicorn`, and the rocking horse of `wooden_horse`. All look along +z."""

from __future__ import annotations

import numpy as np

from models.files import save
from models.finishes import fur, standing_coat, wood
from models.model import Look, Model
from models.shapes import box, curve, ellipsoid, mirrored, tube

GROUND = box((0, -1, 0), (9, 1, 9), 0.0)


def horse(coat: Look, mane: Look, hoof: Look, nose: Look, stance: float = 1.0) -> Model:
    """A standing horse, 2.37 units tall; `stance` shifts how far the left legs stand before the right ones."""
    model = Model(coat, 0.55)
    add = model.add
    add(ellipsoid((0, 1.22, -0.02), (0.285, 0.345, 0.70)))
    add(ellipsoid((0, 1.25, 0.44), (0.26, 0.34, 0.30)), 0.15)
    add(ellipsoid((0, 1.30, -0.52), (0.28, 0.33, 0.36)), 0.15)
    add(tube([(0, 1.52, 0.16), (0, 1.56, 0.36)], [0.07, 0.09]), 0.15)
    add(tube([(0, 1.32, 0.48), (0, 1.70, 0.82), (0, 2.03, 1.00)], [0.28, 0.19, 0.14], (1.45, 1, 1)), 0.14)
    # Head: skull, cheek, nose ridge, muzzle with a lip line.
    add(tube([(0, 2.08, 1.04), (0, 1.90, 1.27), (0, 1.70, 1.47)], [0.14, 0.125, 0.085], (1.22, 1, 1)), 0.06)
    add(mirrored(ellipsoid((0.045, 1.90, 1.14), (0.065, 0.15, 0.13), (-40, 0, 0))), 0.05)
    add(tube([(0, 1.68, 1.49), (0, 1.63, 1.53)], [0.088, 0.082], (1.1, 1, 1)), 0.05, nose)
    add(mirrored(ellipsoid((0.052, 1.655, 1.59), (0.022, 0.03, 0.022))), 0.02, nose)
    add(mirrored(tube([(0.065, 2.13, 1.02), (0.092, 2.25, 1.05), (0.095, 2.37, 1.06)], [0.052, 0.06, 0.014])), 0.03)
    add(mirrored(ellipsoid((0.1, 1.985, 1.22), (0.03, 0.04, 0.042))), 0.01, (0.012, 0.008, 0.006, 0.12))
    for side, step in ((1, 0.05 * stance), (-1, -0.05 * stance)):
        x = side * 0.17
        fore = [(x, 1.15, 0.46), (x, 0.90, 0.42), (x, 0.54, 0.46 + step), (x, 0.18, 0.45 + step)]
        add(tube(fore, [0.17, 0.115, 0.068, 0.05]), 0.10)
        add(ellipsoid((x, 0.53, 0.47 + step), (0.07, 0.09, 0.075)), 0.05)
        add(tube([(x, 0.17, 0.45 + step), (x, 0.09, 0.49 + step)], [0.06, 0.058]), 0.04)
        add(tube([(x, 0.075, 0.50 + step), (x, 0.0, 0.53 + step)], [0.07, 0.095]), 0.0, hoof)
        hind = [(x, 1.22, -0.58), (x * 1.1, 0.93, -0.50), (x * 1.05, 0.58, -0.80 - step), (x, 0.18, -0.74 - step)]
        add(tube(hind, [0.24, 0.155, 0.075, 0.052]), 0.12)
        add(ellipsoid((x * 1.05, 0.59, -0.81 - step), (0.06, 0.09, 0.08)), 0.05)
        add(tube([(x, 0.17, -0.74 - step), (x, 0.09, -0.70 - step)], [0.06, 0.058]), 0.04)
        add(tube([(x, 0.075, -0.69 - step), (x, 0.0, -0.66 - step)], [0.07, 0.095]), 0.0, hoof)
    # Mane: a crest of overlapping locks down the neck, and a forelock; then the tail.
    for t in np.linspace(0, 1, 9):
        y, z = 2.17 - 0.60 * t, 0.97 - 0.58 * t
        lock = [(0, y, z), (0, y - 0.03, z - 0.10), (0, y - 0.15, z - 0.15)]
        add(tube(lock, [0.09, 0.075, 0.02], (1.7, 1, 1)), 0.03, mane)
    add(tube([(0, 2.20, 1.02), (0, 2.16, 1.14), (0, 2.02, 1.24)], [0.06, 0.055, 0.015]), 0.02, mane)
    tail = [(0, 1.46, -0.84), (0, 1.45, -0.98), (0, 1.25, -1.10), (0, 0.85, -1.14), (0, 0.48, -1.08)]
    add(tube(*curve(tail, [0.06, 0.075, 0.105, 0.115, 0.02])), 0.04, mane)
    model.cut(GROUND)
    model.paint(mirrored(ellipsoid((0.098, 2.24, 1.1), (0.026, 0.085, 0.03))), nose, 0.02)
    model.paint(mirrored(ellipsoid((0.055, 1.672, 1.605), (0.014, 0.02, 0.02))), (0.01, 0.006, 0.005))
    model.paint(box((0, 1.598, 1.56), (0.2, 0.005, 0.06), 0.0), (0.015, 0.008, 0.006), 0.006)
    model.paint(mirrored(ellipsoid((0.128, 2.0, 1.235), (0.012, 0.009, 0.009))), (0.8, 0.8, 0.8, 0.1), 0.004)
    model.finish = fur(lambda p: standing_coat(p, 0.95, (0.5, 0.5)), 0.05, 0.3)
    return model


def pegasus(seed: int) -> None:
    """A bay horse: black mane, tail and lower legs, a white blaze."""
    black = (0.022, 0.014, 0.01)
    model = horse((0.30, 0.115, 0.038), black, (0.05, 0.04, 0.034, 0.4), (0.05, 0.03, 0.025))
    socks = box((0, 0.3, 0), (1, 0.3, 2), 0.0)
    model.paints.insert(0, (socks, black, 0.22))
    model.paints.insert(1, (ellipsoid((0, 1.05, 0), (0.22, 0.2, 0.7)), (0.40, 0.20, 0.09), 0.1))
    model.paint(tube([(0, 2.08, 1.22), (0, 1.82, 1.48)], [0.03, 0.018]), (0.8, 0.77, 0.72), 0.012)
    model.paint(box((0, 0.04, 0), (1, 0.055, 2), 0.0), (0.045, 0.036, 0.03, 0.4), 0.01)
    bounds = ((-0.5, -0.1, -1.35), (0.5, 2.5, 1.75))
    save("pegasus/horse", model, bounds, 0.036, seed=seed, texture=768, place=(1.5, 0, -0.4))


def unicorn(seed: int) -> None:
    """A white pony with a long golden mane: the horse with shorter legs and more hair."""
    mane, hoof = (0.62, 0.40, 0.16), (0.30, 0.20, 0.14, 0.4)
    tall = horse((0.74, 0.71, 0.68), mane, hoof, (0.52, 0.33, 0.30), stance=2.0)
    finish, tall.finish = tall.finish, None
    for t in np.linspace(0, 1, 6):
        y, z = 2.14 - 0.56 * t, 0.97 - 0.54 * t
        lock = [(-0.05, y, z), (-0.17, y - 0.05, z - 0.01), (-0.205, y - 0.25, z - 0.02), (-0.2, y - 0.44, z + 0.04)]
        tall.add(tube(*curve(lock, [0.07, 0.075, 0.065, 0.015])), 0.03, mane)
    tail = [(0, 1.46, -0.86), (0, 1.46, -1.04), (0, 1.2, -1.2), (0, 0.85, -1.22), (0, 0.5, -1.3)]
    tall.add(tube(*curve(tail, [0.07, 0.1, 0.15, 0.15, 0.02])), 0.04, mane)

    def shortened(p: np.ndarray) -> np.ndarray:
        # The lowest 0.66 units of the pony are the horse's lowest 0.96.
        t = np.clip(p[:, 1] / 0.66, 0, 1)
        y = p[:, 1] + 0.30 * t * t * (3 - 2 * t)
        return np.column_stack([p[:, 0], y, p[:, 2]]).astype(np.float32)

    model = Model(tall.look, 0.5)
    model.add(lambda p: tall.distance(shortened(p)) * 0.6)

    def coat(p: np.ndarray, normals: np.ndarray, looks: np.ndarray, seed: int) -> np.ndarray:
        return finish(p, normals, tall.looks(shortened(p), normals, seed), seed)

    model.finish = coat
    bounds = ((-0.5, -0.1, -1.5), (0.5, 2.2, 1.75))
    save("unicorn/pony", model, bounds, 0.036, seed=seed, texture=768, scale=50, place=(0, 10, 0))


def wooden_horse(seed: int) -> None:
    """A rocking horse carved from one kind of wood, 1.9 units tall, rockers 2.5 long."""
    pale, brown, dark = (0.50, 0.27, 0.115), (0.17, 0.07, 0.025), (0.03, 0.016, 0.01, 0.25)
    model = Model(pale, 0.45)
    add = model.add
    add(tube([(0, 1.02, 0.48), (0, 1.0, 0), (0, 1.03, -0.5)], [0.27, 0.25, 0.27], (1.15, 1, 1)))
    add(tube([(0, 1.1, 0.52), (0, 1.45, 0.74), (0, 1.66, 0.84)], [0.25, 0.18, 0.15], (1.5, 1, 1)), 0.08)
    add(tube([(0, 1.69, 0.86), (0, 1.52, 1.1), (0, 1.42, 1.22)], [0.17, 0.14, 0.115], (1.35, 1, 1)), 0.05)
    add(mirrored(tube([(0.075, 1.79, 0.80), (0.095, 1.99, 0.82)], [0.06, 0.016])), 0.03)
    add(mirrored(ellipsoid((0.105, 1.655, 1.0), (0.03, 0.045, 0.045))), 0.0, dark)
    # A mane of carved scallops, and a carved tail.
    for t in np.linspace(0, 1, 7):
        add(ellipsoid((0, 1.83 - 0.62 * t, 0.74 - 0.42 * t), (0.07, 0.115, 0.1), (35, 0, 0)), 0.02, brown)
    add(ellipsoid((0, 1.82, 0.95), (0.06, 0.06, 0.1), (30, 0, 0)), 0.02, brown)
    tail = [(0, 1.2, -0.68), (0, 1.25, -0.84), (0, 1.02, -1.0), (0, 0.72, -0.98), (0, 0.58, -1.06)]
    add(tube(*curve(tail, [0.07, 0.085, 0.105, 0.09, 0.02])), 0.03, brown)
    for side in (1, -1):
        x = side * 0.16
        add(tube([(x, 0.95, 0.45), (x * 1.35, 0.55, 0.62), (x * 1.55, 0.2, 0.72)], [0.16, 0.09, 0.075]), 0.06)
        add(tube([(x, 0.95, -0.48), (x * 1.35, 0.55, -0.62), (x * 1.55, 0.2, -0.74)], [0.18, 0.095, 0.075]), 0.06)
        z = np.linspace(-1.25, 1.25, 15)
        runner = np.column_stack([np.full(15, x * 1.6), 0.09 + 0.2 * (z / 1.25) ** 2, z])
        add(tube(runner, np.full(15, 0.085), (1.4, 1, 1)), 0.01, brown)
    for z in (0.68, -0.7):
        add(tube([(-0.26, 0.16, z), (0.26, 0.16, z)], [0.05, 0.05]), 0.01, brown)
    model.paint(mirrored(ellipsoid((0.085, 1.40, 1.32), (0.02, 0.025, 0.025))), dark)
    model.paint(box((0, 1.345, 1.3), (0.2, 0.01, 0.08), 0.0, (-30, 0, 0)), dark, 0.006)
    model.paint(mirrored(ellipsoid((0.125, 1.67, 1.02), (0.02, 0.012, 0.012))), (0.85, 0.85, 0.85, 0.25), 0.004)
    model.finish = wood((0.42, 0.34, 0.28), 0.045)
    bounds = ((-0.45, -0.1, -1.45), (0.45, 2.1, 1.45))
    save("wooden_horse/rocking_horse", model, bounds, 0.033, seed=seed, scale=0.5, place=(0, 0.2, 0))
