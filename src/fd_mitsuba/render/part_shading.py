"""The part's BSDF as Mitsuba ships it, with field values in place of some of its parameters."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.scene.part_material import PartMaterial

CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1}
"""Fields that can feed a BSDF parameter, and how many numbers they have. `normal` bends the shading frame instead."""


@dataclass(frozen=True)
class PartShading:
    """Which BSDF the part has, and what of it the fields decide.

    Attributes:
        bsdf: a description for `mi.load_dict`; values may be Mitsuba objects.
        feeds: field -> parameter, such as {"base_color": "reflectance"}; dots lead through nested descriptions
            ("nested.base_color"). Parameters must accept a texture. "normal" has none.
        squared: fields whose square is fed: a microfacet alpha is the square of the roughness.
    """

    bsdf: Mapping[str, Any]
    feeds: Mapping[str, str] = field(default_factory=dict)
    squared: Collection[str] = ()

    def __post_init__(self) -> None:
        unknown = set(self.feeds) - set(CHANNELS)
        if unknown:
            raise ValueError(f"{sorted(unknown)} cannot feed a BSDF; known fields: {', '.join(CHANNELS)}")

    @classmethod
    def of(cls, material: PartMaterial) -> PartShading:
        """What the scene file says about the part."""
        return cls(material.description, material.feeds, material.squared)

    def load(self, textures: Mapping[str, Any]) -> Any:
        """The BSDF with a texture (an object or a description) for each fed parameter."""
        description = _copied(self.bsdf)
        for name, parameter in self.feeds.items():
            *nested, last = parameter.split(".")
            target = description
            for key in nested:
                target = target[key]
            target[last] = textures[name]
        with file_threads():
            return mi.load_dict(description, parallel=False)


class FilmShading:
    """The BSDF with film-sized textures: it looks values up at `uv`, the pixel's place on the film."""

    def __init__(self, shading: PartShading) -> None:
        self.fed, self._squared = tuple(shading.feeds), frozenset(shading.squared)
        textures = {name: _film_texture(CHANNELS[name]) for name in self.fed}
        self.bsdf = shading.load(textures)
        self._data = {name: mi.traverse(texture) for name, texture in textures.items()}
        for name in self.fed:  # kernels know a texture that was changed from one that was not
            self.set(name, dr.opaque(mi.Float, 0.5, 4 * CHANNELS[name]), 2, 2)

    def fed_value(self, name: str, values: Any) -> Any:
        """What a parameter gets for a field's values (any kind of array)."""
        return values * values if name in self._squared else values

    def set(self, name: str, values: mi.Float, height: int, width: int) -> None:
        """One field's values, pixel after pixel; gradients flow back to them."""
        # The texture alone is told, not the BSDF: that would take means over the film, which only steer sampling.
        parameters = self._data[name]
        parameters["data"] = mi.TensorXf(self.fed_value(name, values), (height, width, CHANNELS[name]))
        parameters.update()


def bounce_shading(shading: PartShading) -> Any:
    """The BSDF that light meets on its way further: the fed parameters are read from the mesh's vertices."""
    attributes = {name: {"type": "mesh_attribute", "name": f"vertex_{name}"} for name in shading.feeds}
    return shading.load(attributes)


def _film_texture(channels: int) -> Any:
    return mi.load_dict(
        {
            "type": "bitmap",
            "data": dr.full(mi.TensorXf, 0.5, (2, 2, channels)),
            "raw": True,
            "filter_type": "nearest",
            "wrap_mode": "clamp",
            "format": "variant",
        }
    )


def _copied(description: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of nested dictionaries; Mitsuba's objects in it stay the same."""
    return {
        key: _copied(value) if isinstance(value, Mapping) else copy.copy(value) if isinstance(value, list) else value
        for key, value in description.items()
    }
