"""Where 32-bit floats are too coarse, or too small or large, for a scene's coordinates."""

from __future__ import annotations

import numpy as np

FINE = 5e-6
"""Steps of 32-bit floats up to this share of an object's size are lost in what it takes to store it anyway: at the
origin they are 3e-8 to 1.2e-7 of it. Beyond, coordinates are kept and written in 64 bits."""

_VISIBLE = 5e-5
"""Steps above this share show: a face a hundredth of the object long is bent by half a degree."""
_SMALLEST, _LARGEST = 1e-9, 1e10
"""Longest sides between which Mitsuba renders; beyond, squares of lengths vanish or overflow in 32 bits."""
_RAY_OFFSET = 8.9e-5
"""How far from a surface near the origin Mitsuba starts its rays, in any unit."""
_OFFSET_VISIBLE = 0.04
"""Share of the object's size; contact shadows and creases of this width are lit wrongly."""


def float_step(points: np.ndarray) -> float:
    """Distance of neighbouring 32-bit floats at the largest coordinate of points (N, 3)."""
    return float(np.spacing(np.float32(np.abs(points).max(initial=0.0))))


def is_coarse(points: np.ndarray) -> bool:
    """Whether 32-bit floats are too coarse for the points (N, 3), because these lie far from the origin."""
    if not len(points):
        return False
    size = float(np.ptp(points, axis=0).max())
    return float_step(points) > FINE * size


def size_problem(longest: float) -> str | None:
    """Why nothing can be rendered of an object with this longest side, and what to do; None if it can."""
    if _SMALLEST <= longest <= _LARGEST:
        return None
    kind = "small" if longest < _SMALLEST else "large"
    return f"its longest side is {longest:.3g}, too {kind} for 32-bit floats; give it a size near 1"


def size_warnings(points: np.ndarray) -> list[str]:
    """What can be seen of the limits of 32-bit floats in an object with these vertices (N, 3), a sentence each."""
    warnings, size, step = [], float(np.ptp(points, axis=0).max()), float_step(points)
    if step > _VISIBLE * size:
        place = f"its coordinates reach {np.abs(points).max():.3g}, where 32-bit floats are {step:.2g} apart"
        warnings.append(
            f"{place}, {step / size:.2%} of its size, which shows in other programs and in plain Mitsuba; "
            "move everything to the origin"
        )
    if _RAY_OFFSET > _OFFSET_VISIBLE * size:
        factor = 10 ** int(np.ceil(-np.log10(size)))
        warnings.append(
            f"its longest side is {size:.3g}, and Mitsuba starts rays {_RAY_OFFSET:.1g} away from a surface, "
            f"{_RAY_OFFSET / size:.0%} of that, so that shadows are wrong; scale everything by {factor:g}"
        )
    return warnings
