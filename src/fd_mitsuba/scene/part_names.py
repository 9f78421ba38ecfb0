"""What the parts of a scene are called."""

from __future__ import annotations

import re

from fd_mitsuba.conventions import BASE_NAME, DEFAULT_PART_NAME
from fd_mitsuba.scene.part_stack import StackedPart, free_name
from fd_mitsuba.scene.scene_file import SceneElement

_PART_NAME = re.compile(r"\w[\w.-]{0,63}")


def part_names(elements: list[SceneElement], earlier: tuple[StackedPart, ...]) -> list[str]:
    """The part of each region; regions without one share `part`, or the first free name where that is taken.

    Args:
        elements: of the regions.
        earlier: the parts of earlier rounds, whose names are taken.

    Raises:
        UserError: a name that no file can have, or that is taken.
    """
    taken = [name for part in earlier for name in (part.name, part.shape)]
    given = [element.properties.get("part") for element in elements]
    default = free_name(DEFAULT_PART_NAME, taken)
    if default != DEFAULT_PART_NAME:
        default = free_name(default, [*taken, *(str(name) for name in given)])
    for element, name in zip(elements, given, strict=True):
        if name is None:
            continue
        if not isinstance(name, str) or not is_part_name(name):
            raise element.error(
                f"part {name!r} cannot name a file; use letters, digits, '_' and '-', and not {BASE_NAME!r}"
            )
        if name.lower() in {other.lower() for other in taken}:
            raise element.error(f"part {name!r} is there from an earlier round; name it {free_name(name, taken)!r}")
    return [default if name is None else name for name in given]


def is_part_name(name: str) -> bool:
    """Whether a part can be called so: files and nodes take its name."""
    return bool(_PART_NAME.fullmatch(name)) and not name.endswith(".") and name != BASE_NAME
