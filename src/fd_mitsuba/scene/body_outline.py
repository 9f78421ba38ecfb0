"""Where the eyes and the back of a body are, as far as its outline tells.

Eyes are high up in the stretch in which a head is widest; the back of an animal is where no neck reaches over it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float

_SLICES = 50
"""Into which an object's height is cut."""
_NECK, _SHOULDERS, _WIDE = 0.85, 1.5, 0.95
"""Shares of the head's width: at most so wide is a neck, more than so wide are shoulders or arms, the eyes are where it
is at least so wide."""
_FIRST_SLICES = 4
"""A head grows quickly wider at its top; nothing there is a shoulder."""
_EYES_BELOW = 0.3
"""The top, as a share of the width there: of a ball this is 0.53 of its radius."""
_BACK_SLICES, _LEVEL = 9, 0.1
"""Into which the middle of an animal is cut, and how much of its height a back may rise above its lowest slice."""


def eye_level(points: Float[np.ndarray, "N 3"], top: float, height: float) -> Float[np.ndarray, "M 3"]:
    """(M, 3) those of the points around the head at the height of its eyes; at least one.

    From the top downwards, until it gets narrow as at a neck, or wide as at shoulders. Where no neck is found in the
    upper half, as in a doll or a pot, the head counts as a quarter of the height.

    Args:
        points: of the surface, evenly by area, +y up; of an animal those of its front.
        top: height of the head's top, of which ears and horns are no part.
        height: of the whole object.

    >>> ball = np.random.default_rng(0).normal(size=(4000, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> snowman = np.concatenate([ball, 2 * ball - [0, 2.8, 0]])
    >>> bool(np.abs(eye_level(snowman, 1.0, 5.8)[:, 1]).max() < 0.35)
    True
    """
    below = points[points[:, 1] <= top]
    below = below if len(below) else points  # of a plate that lies
    step = height / _SLICES
    slices: list[np.ndarray] = []
    widths: list[float] = []
    necked = False
    for number in range(_SLICES // 2):
        found = below[np.abs(below[:, 1] - top + (number + 1) * step) <= step]
        width = float(np.ptp(np.quantile(found[:, 0], (0.02, 0.98)))) if len(found) else 0.0
        necked = bool(widths) and width < _NECK * max(widths)
        if necked or (number >= _FIRST_SLICES and width > _SHOULDERS * max(widths)):
            break
        slices.append(found)
        widths.append(width)
    if not necked:
        slices, widths = slices[: _SLICES // 4], widths[: _SLICES // 4]
    wide = [found for found, width in zip(slices, widths, strict=True) if len(found) and width >= _WIDE * max(widths)]
    return wide[len(wide) // 3] if wide else below


def animal_eye_level(points: Float[np.ndarray, "N 3"], top: float, height: float) -> Float[np.ndarray, "M 3"]:
    """(M, 3) those of the points around an animal's head at the height of its eyes; at least one.

    Its muzzle is below them and its chest behind, so that no outline tells; but they are as far below the top as in a
    ball, half of the radius.

    Args:
        points, top, height: as in `eye_level`.

    >>> ball = np.random.default_rng(0).normal(size=(4000, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> bool(np.abs(animal_eye_level(ball, 1.0, 6.0)[:, 1].mean() - 0.47) < 0.12)
    True
    """
    step = height / _SLICES
    for number in range(1, _SLICES // 2):
        found = points[np.abs(points[:, 1] - top + number * step) <= step]
        if len(found) and number * step >= _EYES_BELOW * np.ptp(np.quantile(found[:, 0], (0.02, 0.98))):
            return found
    return eye_level(points, top, height)


def back_slice(points: Float[np.ndarray, "N 3"], height: float) -> Float[np.ndarray, "M 3"]:
    """(M, 3) those of the points that lie across the back: next to the centre, and not much higher than the lowest.

    Args:
        points: of the surface in the middle of an animal's length, evenly by area, +y up, +z ahead.
        height: of the whole animal.

    >>> neck = np.array([[0, 1.0, z] for z in np.linspace(-0.01, 0.2, 50)])
    >>> trunk = np.array([[0, 0.6, z] for z in np.linspace(-0.2, 0.2, 100)])
    >>> bool(back_slice(np.concatenate([neck, trunk]), 1.0)[:, 1].max() < 0.7)
    True
    """
    along = points[:, 2]
    edges = np.linspace(along.min(), along.max(), _BACK_SLICES + 1)
    slices = [points[(along >= low) & (along <= high)] for low, high in pairwise(edges)]
    tops = np.array([found[:, 1].max() if len(found) else np.inf for found in slices])
    level = np.flatnonzero(tops <= tops.min() + _LEVEL * height)
    return slices[level[np.argmin(np.abs(level - _BACK_SLICES // 2))]]
