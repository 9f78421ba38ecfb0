"""Focal regions put by words on the base of a scene, as a file of regions that takes the place of the scene's own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fd_mitsuba.assets.region_xml import region_element
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.load_scene import load_base
from fd_mitsuba.scene.plugins import DUAL_PATH
from fd_mitsuba.scene.region_size import region_size
from fd_mitsuba.scene.region_words import ObjectPlaces, PlacedRegion


def placed_regions(
    places: ObjectPlaces, at: Sequence[str], size: str | None, subtract: bool = False
) -> tuple[list[PlacedRegion], list[str]]:
    """A region for each place, named apart, and a sentence about each.

    Args:
        subtract: whether what they hold is cut out of the base.

    Raises:
        UserError: a place or a size that is not known.
    """
    extent = region_size(size, places.longest_side)
    found = [places.find(word) for word in at]
    count = Counter(place.name for place in found)
    regions = [
        places.region(place, extent, f"{place.name}_{number}" if count[place.name] > 1 else place.name, subtract)
        for number, place in enumerate(found, 1)
    ]
    shown = " x ".join(f"{value:.3g}" for value in extent) + (", subtracts" if subtract else "")
    return regions, [f"{region.name}: {place.about}, {shown}" for place, region in zip(found, regions, strict=True)]


def write_placed_regions(
    scene: Path,
    parameters: Mapping[str, str],
    at: Sequence[str],
    size: str | None,
    target: Path,
    subtract: bool = False,
) -> list[str]:
    """Write regions at places of a scene's base to `target`, an XML file for `--regions`; a sentence about each.

    Raises:
        UserError: a scene that cannot be read, a place or a size that is not known.
    """
    base = load_base(scene, parameters)
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in base[:-1]])
    vertices = np.concatenate([mesh.vertices for mesh in base])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(base, starts, strict=True)])
    regions, about = placed_regions(ObjectPlaces(vertices, faces), at, size, subtract)
    root = ElementTree.Element("scene", version="3.0.0")
    integrator = ElementTree.SubElement(root, "integrator", type=DUAL_PATH)
    ElementTree.SubElement(integrator, "boolean", name="only_these_regions", value="true")
    root.extend(region_element(region) for region in regions)
    ElementTree.indent(root)
    write_atomically(target, ElementTree.tostring(root, encoding="utf-8") + b"\n")
    return about
