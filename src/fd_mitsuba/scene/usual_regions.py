"""Where on an object a part usually is, and how large: what `--at` and `--size` mean where they are left out.

The figures are medians over the makers of the built-in prior's training data (`prior.data.fine`), on fifteen of its
bodies; what is worn on a head is measured by the head's width, all else by the object's longest side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fd_mitsuba.scene.region_words import POINT, ObjectPlaces, Place, PlacedRegion, upright

_ROOM = 1.35
"""How much larger than its usual part a region is: an ellipsoid holds a cylinder that is 1.41 times smaller."""
_LEVEL = 0.7
"""Least upward share of a normal on top of something."""


@dataclass(frozen=True)
class UsualRegion:
    """Of one part, in units of the head's width or of the object's longest side.

    Attributes:
        size: width, along the place's normal, and the third way, as in `--size`.
        out: of the middle, from the surface along the normal.
        up: of the middle, above the place, where the normal is level.
        ahead: of the middle, before the place.
        place: as in `--at`.
        by_head: whether the unit is the head's width.
    """

    size: tuple[float, float, float]
    out: float
    up: float = 0.0
    ahead: float = 0.0
    place: str = "head"
    by_head: bool = True


def _on(place: str, size: tuple[float, float, float], out: float, up: float = 0.0) -> UsualRegion:
    return UsualRegion(size, out, up, place=place, by_head=False)


_FACE = "front of the head"
USUAL_REGIONS: Mapping[str, UsualRegion] = {
    "pointed hat": UsualRegion((1.56, 1.24, 1.56), 0.35),
    "top hat": UsualRegion((1.38, 0.87, 1.38), 0.22),
    "hat": UsualRegion((1.47, 0.52, 1.47), 0.0),
    "crown": UsualRegion((0.94, 0.52, 0.97), 0.06),
    "mushroom cap": UsualRegion((1.39, 0.59, 1.40), 0.12),
    "halo": UsualRegion((0.84, 0.21, 0.85), 0.2),
    "candle": UsualRegion((0.33, 1.05, 0.34), 0.43),
    "propeller": UsualRegion((1.09, 0.5, 1.07), 0.16),
    "ears": UsualRegion((1.0, 0.8, 0.3), 0.22),
    "umbrella": UsualRegion((1.72, 1.31, 1.72), 0.56),
    "antlers": UsualRegion((1.87, 1.15, 0.45), 0.39),
    "horns": UsualRegion((1.43, 0.79, 0.3), 0.1),
    "butterfly": UsualRegion((1.34, 0.64, 1.39), 0.27),
    "flower": UsualRegion((0.76, 0.98, 0.55), 0.38),
    "horn": UsualRegion((0.4, 0.98, 0.7), 0.14, ahead=0.45),
    "glasses": UsualRegion((1.05, 0.75, 0.48), -0.33, 0.08, place=_FACE),
    "bow tie": UsualRegion((0.9, 0.9, 0.9), -0.4, -0.45, place=_FACE),
    "scarf": UsualRegion((1.0, 1.1, 1.4), -0.4, -0.7, place=_FACE),
    "tusks": UsualRegion((0.7, 0.8, 0.7), 0.3, -0.1, place=_FACE),
    "wings": _on("back", (1.0, 0.31, 0.32), 0.05, 0.12),
    "bat wings": _on("back", (0.85, 0.33, 0.38), 0.04, 0.1),
    "cape": _on("back", (0.56, 0.38, 0.54), -0.04, -0.08),
    "backpack": _on("back", (0.4, 0.42, 0.33), -0.05, 0.07),
    "spikes": _on("back", (0.12, 0.31, 0.5), 0.05, 0.1),
    "fin": _on("back", (0.1, 0.26, 0.32), 0.05, 0.2),
    "saddle": _on("back", (0.43, 0.39, 0.25), -0.04),
    "tail": _on("rear", (0.25, 0.38, 0.42), 0.1),
    "handle": _on("left side", (0.5, 0.38, 0.13), 0.07),
    "sword": _on("left side", (0.8, 0.31, 0.16), 0.08, 0.22),
    "shield": _on("left side", (0.41, 0.15, 0.33), 0.05),
    "skateboard": _on("bottom", (0.33, 0.24, 0.63), 0.03),
    "boots": _on("bottom", (0.3, 0.26, 0.4), -0.1),
}  # fmt: skip
"""By the names of parts that the built-in priors' vocabulary has."""


HEADLESS = frozenset(("vase", "mug", "pumpkin", "ball", "chair", "car", "teapot", "bottle", "shoe", "house", "tree"))
"""Bodies of that vocabulary whose highest end is no head: that of a teapot may be its spout."""


@dataclass(frozen=True)
class PromptedParts:
    """What a prompt asks for, as far as regions are concerned; see `guidance.prompted_part`.

    Attributes:
        only: name of the one part; None: none that is known, or several.
        alone: of several parts, by name and in the prompt's order, a prompt for each; else empty.
        body: what the prompt calls the object itself; None: it does not say.
        headless: whether that is one of `HEADLESS`.
    """

    only: str | None = None
    alone: Mapping[str, str] = field(default_factory=dict)
    body: str | None = None
    headless: bool = False


def usual_region(part: str | None, place: Place) -> UsualRegion | None:
    """What is known of a part at a place; None: nothing. What stands on a head may stand anywhere else, too."""
    usual = USUAL_REGIONS.get(part or "")
    if usual is None or usual.place == "head":
        return usual
    own = usual.place.replace(" the ", " ").replace(" ", "_")
    return usual if place.name in (own, own.replace("left", "right"), POINT) else None


def usual_place(part: str | None, headless: bool = False) -> str:
    """Where `--at` puts a part where nothing is said; on the head of what is not known.

    Args:
        headless: of an object without a head, what belongs there is on its top.
    """
    usual = USUAL_REGIONS.get(part or "")
    place = "head" if usual is None else usual.place
    return "top" if headless and place == "head" else place


def region_for(usual: UsualRegion, places: ObjectPlaces, place: Place, name: str | None = None) -> PlacedRegion:
    """The ellipsoid for a part at a place, a little larger than the part usually is."""
    unit = places.longest_side
    if usual.by_head:
        unit = places.top_width if place.name == "top" else places.head_width
    half = _ROOM * unit * np.asarray(usual.size) / 2
    level = abs(place.normal[1]) < _LEVEL
    shift = np.array([0.0, usual.up if level else 0.0, 0.0 if level else usual.ahead])
    shift *= place.name != POINT  # there, and not beside it
    centre = place.point + unit * (usual.out * place.normal + shift)
    return PlacedRegion(name or place.name, centre, half, upright(place.normal))
