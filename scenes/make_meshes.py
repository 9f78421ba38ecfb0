"""Makes the meshes and textures of the shipped scenes: `python scenes/make_meshes.py [--seed N] [scene ...]`.

The same seed writes the same files; the seed moves hairs, grain and speckles, never a shape. Every creature looks along
+z. Each scene has units and an origin of its own, as scenes that people bring along have.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from models import cattle, equines, figures, pets, things

MAKERS: dict[str, Callable[[int], None]] = {
    "pegasus": equines.pegasus,
    "unicorn": equines.unicorn,
    "wooden_horse": equines.wooden_horse,
    "cat": pets.cat,
    "skateboard_dog": pets.skateboard_dog,
    "rabbit_glasses": pets.rabbit,
    "deer": cattle.deer,
    "bronze_bull": cattle.bronze_bull,
    "snowman": figures.snowman,
    "superhero": figures.superhero,
    "teddy_backpack": figures.teddy,
    "mug": things.mug,
    "vase": things.vase,
    "cup_straw": things.cup,
    "stump_butterfly": things.stump,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="scene", help=f"any of {', '.join(MAKERS)}; all without one")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.scenes) - set(MAKERS))
    if unknown:
        parser.error(f"no scene {', '.join(unknown)}; there are {', '.join(MAKERS)}")
    for scene in arguments.scenes or MAKERS:
        MAKERS[scene](arguments.seed)


if __name__ == "__main__":
    main()
