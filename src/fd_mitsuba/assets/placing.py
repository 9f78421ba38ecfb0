"""Focal regions put by words on the base of a scene, as a file of regions that takes the place of the scene's own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fd_mitsuba.assets.region_xml import region_element
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.load_scene import load_base
from fd_mitsuba.scene.plugins import DUAL_PATH
from fd_mitsuba.scene.region_size import region_size
from fd_mitsuba.scene.region_words import ObjectPlaces, PlacedRegion
from fd_mitsuba.scene.usual_regions import PromptedParts, region_for, usual_place, usual_region


def placed_regions(
    places: ObjectPlaces, at: Sequence[str], size: str | None, subtract: bool = False, part: str | None = None
) -> tuple[list[PlacedRegion], list[str]]:
    """A region for each place, named apart, and a sentence about each.

    Args:
        at: as the words of `--at`.
        size: of all; None: what the part usually has at such a place, else a share of the object.
        subtract: whether what they hold is cut out of the base.
        part: what is to grow there, a name of `scene.usual_regions`; None: who knows.

    Raises:
        UserError: a place or a size that is not known.
    """
    extent = region_size(size, places.longest_side)
    found = [places.find(word) for word in at]
    count = Counter(place.name for place in found)
    regions, about = [], []
    for number, place in enumerate(found, 1):
        name = f"{place.name}_{number}" if count[place.name] > 1 else place.name
        usual = usual_region(part, place) if size is None and not subtract else None
        if usual is None:
            region = places.region(place, extent, name, subtract)
        else:
            region = region_for(usual, places, place, name)
        shown = " x ".join(f"{value:.3g}" for value in 2 * region.half_axes)
        why = ", subtracts" if subtract else f", the usual size for {part}" if usual else ""
        regions.append(region)
        about.append(f"{name}: {place.about}, {shown}{why}")
    return regions, about


def prompted_regions(
    places: ObjectPlaces, asked: PromptedParts, at: Sequence[str], size: str | None, subtract: bool
) -> tuple[list[PlacedRegion], list[str]]:
    """Regions for what a prompt asks for, and a sentence about each.

    One part gets all the places. Several get one each, in their order, with a prompt of its own; where there are
    more or fewer places than parts, they grow as one.

    Args:
        at: as the words of `--at`; empty: where each part usually is, or takes off something.
        size: of all; None: of each its usual one, else a share of the object.
        subtract: whether what they hold is cut out of the base.

    Raises:
        UserError: a place or a size that is not known.
    """
    if not asked.alone or len(at) not in (0, len(asked.alone)):
        regions, about = placed_regions(
            places, at or (usual_place(asked.only, asked.headless),), size, subtract, asked.only
        )
        if asked.alone:
            about[-1] += f"; {', '.join(asked.alone)} grow as one there: an --at for each puts them apart"
        return regions, about
    regions, about = [], []
    for number, (part, alone) in enumerate(asked.alone.items()):
        place = at[number] if at else usual_place(part, asked.headless)
        (region,), (said,) = placed_regions(places, [place], size, subtract, part)
        name = part.replace(" ", "_")
        regions.append(replace(region, name=name, part=name, prompt=alone))
        about.append(f"{name} at {said}")
    return regions, about


def write_placed_regions(
    scene: Path,
    parameters: Mapping[str, str],
    at: Sequence[str],
    size: str | None,
    target: Path,
    subtract: bool = False,
    asked: PromptedParts | None = None,
) -> list[str]:
    """Write regions at places of a scene's base to `target`, an XML file for `--regions`; a sentence about each.

    Args:
        at, size, subtract: as in `prompted_regions`.
        asked: what the prompt asks for; None: nothing is known of it.

    Raises:
        UserError: a scene that cannot be read, a place or a size that is not known.
    """
    base = load_base(scene, parameters)
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in base[:-1]])
    vertices = np.concatenate([mesh.vertices for mesh in base])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(base, starts, strict=True)])
    regions, about = prompted_regions(ObjectPlaces(vertices, faces), asked or PromptedParts(), at, size, subtract)
    root = ElementTree.Element("scene", version="3.0.0")
    integrator = ElementTree.SubElement(root, "integrator", type=DUAL_PATH)
    ElementTree.SubElement(integrator, "boolean", name="only_these_regions", value="true")
    root.extend(region_element(region) for region in regions)
    ElementTree.indent(root)
    write_atomically(target, ElementTree.tostring(root, encoding="utf-8") + b"\n")
    return about
