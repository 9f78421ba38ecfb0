"""The parts of the finer prior: every word's maker, where it sits, and which bodies it suits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.prior.data.fine import carried, grown, headwear, ornaments, wings, worn
from fd_mitsuba.prior.data.fine.headwear import Zones
from fd_mitsuba.prior.data.fine.surface import Surface

PARTS: dict[str, Callable[[Surface, np.random.Generator], Zones]] = {
    "wings": wings.wings,
    "horn": grown.horn,
    "antlers": grown.antlers,
    "pointed hat": headwear.pointed_hat,
    "top hat": headwear.top_hat,
    "crown": headwear.crown,
    "handle": carried.handle,
    "skateboard": carried.skateboard,
    "horns": grown.horns,
    "cape": worn.cape,
    "tail": grown.tail,
    "glasses": worn.glasses,
    "butterfly": ornaments.butterfly,
    "flower": ornaments.flower,
    "backpack": worn.backpack,
    "spikes": grown.spikes,
    "bat wings": wings.bat_wings,
    "hat": headwear.hat,
    "halo": ornaments.halo,
    "mushroom cap": headwear.mushroom_cap,
    "candle": ornaments.candle,
    "propeller": ornaments.propeller,
    "ears": ornaments.ears,
    "umbrella": ornaments.umbrella,
    "scarf": worn.scarf,
    "bow tie": worn.bow_tie,
    "sword": carried.sword,
    "shield": carried.shield,
    "saddle": carried.saddle,
    "boots": carried.boots,
    "fin": grown.fin,
    "tusks": grown.tusks,
}
"""Every part word of the vocabulary and its maker."""

ON_HEAD = (
    "horn",
    "antlers",
    "pointed hat",
    "top hat",
    "hat",
    "crown",
    "horns",
    "butterfly",
    "flower",
    "halo",
    "mushroom cap",
    "candle",
    "propeller",
    "ears",
    "umbrella",
)
ON_BACK = ("wings", "bat wings", "fin")
ON_SIDE = ("handle", "sword", "shield")
FITTED = ("cape", "glasses", "scarf", "bow tie", "saddle", "boots", "skateboard", "spikes", "backpack")
"""Parts that hug the body's shape, so that they can only be where they fit."""
LEGGED = frozenset("horse dog cat deer cow pig bear rabbit person robot duck elephant dragon chair turtle".split())
ANIMALS = frozenset("horse dog cat deer cow pig elephant dragon".split())
SUITS: dict[str, frozenset[str]] = {"boots": LEGGED - {"turtle"}, "saddle": ANIMALS | {"turtle"}}
"""Bodies that a part makes sense on; without an entry all of them."""
UNSUITED: dict[str, frozenset[str]] = {
    "glasses": frozenset({"chair", "tree"}),
    "scarf": frozenset({"chair", "car", "house", "turtle", "fish", "shoe"}),
    "bow tie": frozenset({"chair", "car", "house", "turtle", "fish", "shoe"}),
    "tusks": frozenset({"chair", "tree", "house"}),
    "cape": frozenset({"house", "chair", "car", "shoe", "tree"}),
    "backpack": frozenset({"house", "tree", "shoe"}),
}


def suits(body: str, part: str) -> bool:
    """Whether training shows that part on that body."""
    return body in SUITS.get(part, {body}) and body not in UNSUITED.get(part, ())
