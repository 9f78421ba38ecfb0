"""Colours and materials by their words, and what parts look like when nobody names one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fd_mitsuba.prior.data.captions import COLOURS, MATERIALS

Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class Clay:
    """The stand-in material that a part wears in the condition picture; `grey` is linear."""

    grey: float = 0.5
    roughness: float = 0.7
    metallic: float = 0.0


CLAY = Clay()


@dataclass(frozen=True)
class Material:
    """Two 8-bit sRGB colours that alternate in a pattern of `scale` periods across the part, and how they shine."""

    first: Rgb
    second: Rgb
    pattern: Literal["plain", "blotches", "rings", "spots"] = "plain"
    scale: float = 2.0
    roughness: float = 0.5
    metallic: float = 0.0


def plain(colour: Rgb, roughness: float = 0.5, metallic: float = 0.0) -> Material:
    return Material(colour, colour, roughness=roughness, metallic=metallic)


NAMED: dict[str, Material] = {
    "red": plain((200, 24, 24)),
    "orange": plain((240, 120, 16)),
    "yellow": plain((245, 215, 30)),
    "green": plain((36, 145, 50)),
    "blue": plain((32, 66, 200)),
    "purple": plain((120, 42, 160)),
    "pink": plain((245, 140, 185)),
    "brown": plain((104, 60, 32)),
    "black": plain((22, 22, 24)),
    "white": plain((238, 238, 236)),
    "wood": Material((186, 130, 74), (112, 68, 34), "rings", 3.0, roughness=0.7),
    "gold": plain((255, 212, 118), roughness=0.28, metallic=1.0),
    "silver": plain((245, 244, 242), roughness=0.28, metallic=1.0),
    "stone": Material((158, 154, 146), (92, 90, 88), "blotches", 3.0, roughness=0.95),
    "plastic": plain((16, 176, 170), roughness=0.2),
    "ceramic": Material((236, 238, 242), (60, 92, 178), "spots", 3.0, roughness=0.18),
}
"""Anchors: one look a word. Plastic is a glossy turquoise, ceramic white with blue spots, unless a colour is named."""

STYLE_OF_WORD: dict[str, str] = {colour: colour for colour in COLOURS} | {
    phrase.removeprefix("made of "): name for name, phrases in MATERIALS.items() for phrase in phrases
}
"""Word of a caption -> key of `NAMED`."""


def named_look(words: list[str]) -> Material | None:
    """The material that a colour, a material, or both together ("red plastic") stand for; None for neither."""
    styles = [STYLE_OF_WORD[word] for word in words if word in STYLE_OF_WORD]
    colours = [style for style in styles if style in COLOURS]
    materials = [style for style in styles if style not in COLOURS]
    if materials and colours:
        colour = NAMED[colours[0]].first
        material = NAMED[materials[0]]
        darker = tuple(int(0.72 * value) for value in colour)
        second = colour if material.pattern == "plain" else darker
        return replace(material, first=colour, second=second)  # type: ignore[arg-type]
    return NAMED[styles[0]] if styles else None


_LEAF, _IVORY, _ANTLER = plain((60, 130, 50)), plain((232, 220, 190), 0.4), plain((132, 96, 62), 0.6)
_STEEL, _RUBBER, _GOLD = plain((190, 192, 196), 0.3, 1.0), plain((40, 40, 42), 0.6), NAMED["gold"]
_FEATHER = Material((242, 240, 234), (214, 206, 192), "blotches", 2.0, 0.8)
_FABRIC_BLUE, _DENIM = plain((40, 60, 130), 0.8), plain((70, 95, 140), 0.8)

NATURAL: dict[str, tuple[tuple[Material, ...], ...]] = {
    "wings": ((_FEATHER,),),
    "horn": ((Material((240, 228, 200), (206, 184, 140), "rings", 3.0, 0.4),),),
    "antlers": ((_ANTLER,),),
    "pointed hat": ((_FABRIC_BLUE,), (plain((92, 44, 132), 0.8),)),
    "top hat": ((plain((24, 24, 26), 0.5),),),
    "crown": ((_GOLD,),),
    "handle": ((plain((225, 224, 220), 0.3),), (NAMED["wood"],)),
    "skateboard": ((NAMED["wood"], _RUBBER, _STEEL),),
    "horns": ((Material((220, 204, 168), (120, 98, 74), "rings", 1.5, 0.45),),),
    "cape": ((plain((186, 22, 30), 0.8),),),
    "tail": ((Material((120, 80, 46), (84, 54, 32), "blotches", 2.0, 0.9),),),
    "glasses": ((plain((28, 28, 30), 0.3),),),
    "butterfly": ((_RUBBER, Material((240, 130, 30), (40, 30, 28), "blotches", 2.5, 0.7)),),
    "flower": ((_LEAF, plain((240, 190, 30), 0.8), plain((244, 244, 240), 0.8)),),
    "backpack": ((plain((170, 50, 40), 0.8), _DENIM, plain((120, 74, 40), 0.8)), (_DENIM, _FABRIC_BLUE, _RUBBER)),
    "spikes": ((Material((226, 214, 180), (150, 130, 96), "blotches", 1.5, 0.5),),),
}
"""Looks a part may have by nature; a look has one material for each of the part's zones, see `zones`."""


NATURAL_STYLE = {
    "crown": "gold",
    "top hat": "black",
    "cape": "red",
    "skateboard": "wood",
    "wings": "white",
    "antlers": "brown",
    "tail": "brown",
    "glasses": "black",
}
"""The word that says most of a natural look; other looks have none."""


def zones(part: str, piece: np.ndarray, pieces: int) -> np.ndarray:
    """Which of the natural look's materials a point has; `piece` (N,) numbers the closed pieces as they were made.

    Flower: stem, heart, petals. Skateboard: deck, wheels, axles. Butterfly: trunk and feelers, wings. Backpack: pack,
    pocket, flap. Other parts are of one material.
    """
    if part == "flower" or part == "backpack":
        return np.minimum(piece, 2)
    if part == "skateboard":
        return np.where(piece == 0, 0, np.where(piece <= 4, 1, 2))
    if part == "butterfly":
        return ((piece >= 1) & (piece < pieces - 2)).astype(np.int64)
    return np.zeros(len(piece), np.int64)


def linear(colour: Rgb | np.ndarray) -> np.ndarray:
    """Linear RGB of 8-bit sRGB values."""
    value = np.asarray(colour, np.float32) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def cielab(colour: np.ndarray) -> np.ndarray:
    """CIELAB (..., 3), white point D65, of sRGB (..., 3) in [0, 1]."""
    to_xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    xyz = linear(np.asarray(colour) * 255) @ (to_xyz / to_xyz.sum(1, keepdims=True)).T
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


class Pattern:
    """A material laid over space, with its own random phase, axis and tint."""

    def __init__(self, material: Material, extent: float, rng: np.random.Generator, jitter: float = 0.06) -> None:
        self.material = material
        self.roughness = float(np.clip(material.roughness * rng.uniform(0.8, 1.2), 0.15, 1))
        tint = 1 + jitter * rng.uniform(-1, 1, 3) + rng.uniform(-1, 1) * jitter
        self._colours = np.clip(np.stack([linear(material.first), linear(material.second)]) * tint, 0, 0.97)
        self._waves = rng.normal(size=(3, 5)) * (np.pi * material.scale / extent)
        self._phases = rng.uniform(0, 2 * np.pi, 5)
        self._axis = rng.normal(size=3)
        self._axis /= np.linalg.norm(self._axis)
        self._rings = 2 * np.pi * material.scale / (0.5 * extent)

    def colour(self, points: np.ndarray) -> np.ndarray:
        """Linear base colour (N, 3) at points (N, 3)."""
        if self.material.pattern == "plain":
            return np.broadcast_to(self._colours[0].astype(np.float32), points.shape)
        noise = np.sin(points @ self._waves + self._phases).sum(1) / 5  # about -0.8 to 0.8, mostly within 0.4
        if self.material.pattern == "rings":
            off_axis = points - (points @ self._axis)[:, None] * self._axis
            wave = np.sin(np.linalg.norm(off_axis, axis=1) * self._rings + 3 * noise + self._phases[0])
            share = 0.5 + 0.5 * wave
        elif self.material.pattern == "blotches":
            share = np.clip(0.5 + 2 * noise, 0, 1)
        else:
            share = np.clip(6 * (noise - 0.15), 0, 1)
        first, second = self._colours.astype(np.float32)
        return (first + share[:, None] * (second - first)).astype(np.float32)


def random_body_look(rng: np.random.Generator, word: str | None) -> tuple[Material, ...]:
    """One or two materials for a base: any colour, patterned or not, now and then metal; `word` may fix the first."""
    looks = []
    for _ in range(2 if rng.random() < 0.35 else 1):
        bright = rng.uniform(20, 245)
        first = np.clip(bright + rng.normal(size=3) * rng.choice([6, 45]), 8, 250)
        second = np.clip(first * rng.uniform(0.45, 1.2) + rng.normal(size=3) * 15, 8, 250)
        pattern = str(rng.choice(["plain", "blotches", "rings", "spots"], p=[0.5, 0.25, 0.1, 0.15]))
        metallic = 1.0 if rng.random() < 0.08 else 0.0
        colours = [tuple(int(value) for value in colour) for colour in (first, second)]
        looks.append(Material(*colours, pattern, rng.uniform(1.5, 5), rng.uniform(0.2, 0.95), metallic))  # type: ignore[arg-type]
    if word is not None:
        looks[0] = replace(NAMED[word], roughness=looks[0].roughness)
    return tuple(looks)
