"""What the finer prior's parts look like when nobody names a colour: a material for each of their zones."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data import looks as coarse
from fd_mitsuba.prior.data.fine.headwear import Zones
from fd_mitsuba.prior.data.looks import NAMED, Material, plain
from fd_mitsuba.prior.pictures.colour_corpus import pieces_of

_GOLD, _SILVER, _WOOD = NAMED["gold"], NAMED["silver"], NAMED["wood"]
_STEEL, _RUBBER, _BLACK = plain((190, 192, 196), 0.3, 1.0), plain((40, 40, 42), 0.6), plain((24, 24, 26), 0.5)
_FEATHER = Material((242, 240, 234), (214, 206, 192), "blotches", 2.0, 0.8)
_LEATHER, _DARK_LEATHER = plain((120, 74, 40), 0.6), plain((70, 44, 28), 0.6)
_IVORY = Material((232, 220, 190), (206, 186, 148), "blotches", 1.5, 0.4)
_HORN = Material((220, 204, 168), (120, 98, 74), "rings", 1.5, 0.45)
_RUBY, _SAPPHIRE = plain((190, 16, 40), 0.12), plain((24, 48, 190), 0.12)
_RED_CLOTH, _BLUE_CLOTH, _PURPLE_CLOTH = plain((186, 22, 30), 0.8), plain((40, 60, 130), 0.8), plain((92, 44, 132), 0.8)
_STRAW = Material((226, 198, 130), (196, 160, 92), "rings", 4.0, 0.85)
_DENIM, _WHITE = plain((70, 95, 140), 0.8), plain((238, 238, 236), 0.6)
_FUR = Material((120, 80, 46), (84, 54, 32), "blotches", 2.0, 0.9)
_KNIT = Material((200, 40, 44), (236, 226, 214), "rings", 4.0, 0.9)

NATURAL: dict[str, tuple[dict[str, Material], ...]] = {
    "wings": ({"feathers": _FEATHER, "coverts": plain((250, 249, 246), 0.8)},),
    "bat wings": ({"skin": plain((92, 34, 40), 0.7), "bones": plain((52, 24, 30), 0.6)},),
    "horn": ({"horn": plain((240, 228, 200), 0.4), "ridge": plain((214, 178, 96), 0.3, 0.6)},),
    "horns": ({"horns": _HORN},),
    "antlers": ({"antlers": plain((132, 96, 62), 0.6)},),
    "tusks": ({"tusks": _IVORY},),
    "tail": ({"tail": _FUR, "tufts": plain((74, 48, 30), 0.9)},),
    "spikes": ({"spikes": Material((226, 214, 180), (150, 130, 96), "blotches", 1.5, 0.5)},),
    "fin": ({"fin": plain((92, 108, 122), 0.45)},),
    "crown": ({"band": _GOLD, "stones": _RUBY}, {"band": _GOLD, "stones": _SAPPHIRE}),
    "pointed hat": ({"hat": _BLUE_CLOTH, "band": _GOLD}, {"hat": _PURPLE_CLOTH, "band": plain((226, 200, 60), 0.7)}),
    "top hat": ({"hat": _BLACK, "ribbon": _RED_CLOTH},),
    "hat": ({"hat": _STRAW, "ribbon": _BLUE_CLOTH}, {"hat": _LEATHER, "ribbon": _DARK_LEATHER}),
    "halo": ({"ring": _GOLD},),
    "mushroom cap": ({"cap": plain((196, 28, 26), 0.45), "spots": _WHITE},),
    "candle": ({"wax": plain((236, 226, 200), 0.5), "wick": _RUBBER, "flame": plain((255, 176, 40), 0.6)},),
    "propeller": ({"cap": _RED_CLOTH, "blades": plain((245, 215, 30), 0.4)},),
    "ears": ({"ears": plain((226, 220, 214), 0.9), "inner": plain((236, 170, 176), 0.8)},),
    "umbrella": ({"canopy": _RED_CLOTH, "stick": _STEEL, "grip": _WOOD},),
    "flower": (
        {"stem": plain((60, 130, 50)), "heart": plain((240, 190, 30), 0.8), "petals": plain((244, 244, 240), 0.8)},
    ),
    "butterfly": ({"trunk": _RUBBER, "wings": plain((240, 130, 30), 0.7), "marks": plain((40, 30, 28), 0.7)},),
    "handle": ({"handle": plain((225, 224, 220), 0.3)}, {"handle": _WOOD}),
    "skateboard": ({"deck": _WOOD, "wheels": _RUBBER, "trucks": _STEEL},),
    "sword": ({"blade": _SILVER, "hilt": _GOLD}, {"blade": _SILVER, "hilt": _LEATHER}),
    "shield": ({"plate": _WOOD, "rim": _STEEL}, {"plate": plain((36, 60, 170), 0.4), "rim": _GOLD}),
    "saddle": ({"seat": _LEATHER, "blanket": _RED_CLOTH, "stirrups": _STEEL},),
    "boots": ({"boots": _LEATHER, "soles": _RUBBER},),
    "glasses": ({"frame": plain((28, 28, 30), 0.3), "lenses": plain((60, 76, 92), 0.1)},),
    "scarf": ({"scarf": _KNIT},),
    "bow tie": ({"bow": _RED_CLOTH, "knot": _BLACK},),
    "cape": ({"cloth": _RED_CLOTH, "clasps": _GOLD},),
    "backpack": (
        {"pack": plain((170, 50, 40), 0.8), "pocket": _DENIM, "flap": _LEATHER, "straps": _DARK_LEATHER},
        {"pack": _DENIM, "pocket": _BLUE_CLOTH, "flap": _RUBBER, "straps": _RUBBER},
    ),
}
"""Looks that a part may have by nature, each with a material for every zone that its maker returns, in its order."""


NATURAL_STYLE = coarse.NATURAL_STYLE | {
    "halo": "gold",
    "sword": "silver",
    "boots": "brown",
    "saddle": "brown",
    "bow tie": "red",
    "mushroom cap": "red",
    "umbrella": "red",
}
"""The word that says most of a natural look; other looks have none."""


def zone_of_piece(zones: Zones) -> np.ndarray:
    """For each closed piece of the joined part, as `pieces_of` numbers them, the number of its zone."""
    counts = [int(pieces_of(solid).max()) + 1 for solid in zones.values()]
    return np.repeat(np.arange(len(counts)), counts)
