"""How large a focal region is that is put by words: what `--size` says, in the object's unit."""

from __future__ import annotations

import re

from fd_mitsuba.errors import UserError

DEFAULT_SIZE = 0.3
"""Of a region, as a share of the object's longest side."""


def region_size(text: str | None, longest_side: float) -> tuple[float, float, float]:
    """Width, height and depth in the object's unit of what `--size` says.

    Args:
        text: a share of the longest side, as `0.3` or `30%`; three of them, with commas; `8u` is in the scene's unit.

    Raises:
        UserError: anything else, and sizes beyond 0.02 to 2 longest sides.
    """
    if text is None:
        size = DEFAULT_SIZE * longest_side
        return size, size, size
    values = []
    for word in text.split(","):
        found = re.fullmatch(r"\s*([\d.]+(?:[eE][-+]?\d+)?)\s*(%|u)?\s*", word)
        try:
            number = float(found[1]) if found else 0.0
        except ValueError:
            number = 0.0
        unit = found[2] if found else None
        value = number if unit == "u" else number * longest_side / (100 if unit == "%" else 1)
        if not 0.02 * longest_side <= value <= 2 * longest_side:
            raise UserError(
                f"--size {text}: give a share of the longest side from 0.02 to 2, such as 0.3 or 30%, or a length in "
                f"the scene's unit, such as {0.3 * longest_side:.3g}u"
            )
        values.append(value)
    if len(values) not in (1, 3):
        raise UserError(f"--size {text}: give one size, or three: width, height, depth")
    width, height, depth = values * 3 if len(values) == 1 else values
    return width, height, depth
