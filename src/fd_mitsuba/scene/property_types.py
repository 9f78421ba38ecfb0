"""Properties that this program reads itself, and the type that each must have; Mitsuba checks all others."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fd_mitsuba.scene.plugins import DUAL_PATH, FOCAL_REGION

if TYPE_CHECKING:
    from fd_mitsuba.scene.scene_file import SceneElement

NUMBER, POINT, TEXT, TRANSFORM, BOOLEAN = "number", "point", "text", "transform", "boolean"

_BY_PLUGIN: dict[str, dict[str, str]] = {
    "sphere": {"center": POINT, "radius": NUMBER},
    "cylinder": {"p0": POINT, "p1": POINT, "radius": NUMBER},
    "conductor": {"material": TEXT},
    "roughconductor": {"material": TEXT},
    "bitmap": {"raw": BOOLEAN, "wrap_mode": TEXT, "filter_type": TEXT, "to_uv": TRANSFORM},
    "mesh_attribute": {"name": TEXT, "scale": NUMBER},
    FOCAL_REGION: {name: TEXT for name in ("part", "mode", "prompt", "negative_prompt")},
    DUAL_PATH: {
        **{name: TEXT for name in ("prompt", "base_prompt", "negative_prompt", "simple_prompt", "unit")},
        "only_these_regions": BOOLEAN,
    },
}
_BY_KIND: dict[str, dict[str, str]] = {"shape": {"to_world": TRANSFORM}, "emitter": {"to_world": TRANSFORM}}
_EVERYWHERE = {"filename": TEXT}

_MITSUBA_TYPES = {
    NUMBER: ("Float", "Integer"),
    POINT: ("Vector",),
    TEXT: ("String",),
    TRANSFORM: ("Transform",),
    BOOLEAN: ("Bool",),
}
_WRITTEN = {
    NUMBER: '<float name="{}" value="..."/>',
    POINT: '<point name="{}" x="..." y="..." z="..."/>',
    TEXT: '<string name="{}" value="..."/>',
    TRANSFORM: '<transform name="{}">...</transform>',
    BOOLEAN: '<boolean name="{}" value="..."/>',
}
_GIVEN = {
    "Bool": "a boolean",
    "Integer": "an integer",
    "Float": "a number",
    "String": "text",
    "Vector": "a vector",
    "Color": "a colour",
    "Spectrum": "a spectrum",
    "Transform": "a transform",
}


def refuse_wrong_types(element: SceneElement, types: Mapping[str, Any], known: Any) -> None:
    """Raise UserError where a property that this program reads is of another type, or a number of a shape not finite.

    Args:
        types: name -> `mi.Properties.Type` of every property, links to other objects included.
        known: the enumeration `mi.Properties.Type`.
    """
    wanted = {**_EVERYWHERE, **_BY_KIND.get(element.kind, {}), **_BY_PLUGIN.get(element.plugin, {})}
    for name, kind in wanted.items():
        if name not in types:
            continue
        if types[name] not in [getattr(known, item) for item in _MITSUBA_TYPES[kind]]:
            given = _GIVEN.get(str(types[name]).rpartition(".")[2], "an object")
            raise element.error(f"{name} is {given}, not {_article(kind)}; write {_WRITTEN[kind].format(name)}")
        if kind in (NUMBER, POINT) and not all(map(math.isfinite, _numbers(element.properties[name]))):
            raise element.error(f"{name} is NaN or infinite; correct it")


def _numbers(value: Any) -> list[float]:
    return [float(value)] if isinstance(value, int | float) else [float(item) for item in value]


def _article(kind: str) -> str:
    return kind if kind == TEXT else f"a {kind}"
