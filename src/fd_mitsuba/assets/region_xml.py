"""A focal region as a person would write it in a scene."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from fd_mitsuba.scene.focal_region import SUBTRACT
from fd_mitsuba.scene.region_words import PlacedRegion


def region_element(region: PlacedRegion) -> ElementTree.Element:
    """The `<shape type="focal_region">`, with a scale, a rotation and a translation."""
    element = ElementTree.Element("shape", type="focal_region", id=region.name)
    for name, value in (("part", region.part), ("prompt", region.prompt)):
        if value is not None:
            ElementTree.SubElement(element, "string", name=name, value=value.replace("$", r"\$"))
    if region.subtracts:
        ElementTree.SubElement(element, "string", name="mode", value=SUBTRACT)
    transform = ElementTree.SubElement(element, "transform", name="to_world")
    x, y, z = map(_short, region.half_axes)
    ElementTree.SubElement(transform, "scale", x=x, y=y, z=z)
    angle = float(np.degrees(np.arccos(np.clip((np.trace(region.rotation) - 1) / 2, -1, 1))))
    if angle > 1e-4:
        axis = _axis(region.rotation)
        x, y, z = map(_short, axis)
        ElementTree.SubElement(transform, "rotate", x=x, y=y, z=z, angle=_short(angle))
    x, y, z = map(_short, region.centre)
    ElementTree.SubElement(transform, "translate", x=x, y=y, z=z)
    return element


def _axis(rotation: np.ndarray) -> np.ndarray:
    """(3,) the axis of a rotation (3, 3) that is none by 0."""
    vector = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    if np.linalg.norm(vector) < 1e-6:  # half a turn
        vector = np.linalg.eigh(rotation + rotation.T)[1][:, -1]
    return vector / np.linalg.norm(vector)


def _short(value: float) -> str:
    return f"{value + 0.0:.6g}"
