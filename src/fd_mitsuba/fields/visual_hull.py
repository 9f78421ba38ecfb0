"""A shape from its outlines in a few pictures, as a signed distance on a lattice: the visual hull.

    support(p) = min over views that see p of  coverage(where p lies in the view)

What a view does not see, because something known is before it or because it lies outside of the picture, that view says
nothing about. The hull is where the support exceeds a level, chosen so that the hull has the volume that the supports
add up to: what is thinner than a pixel covers no pixel by half, and would be lost with a level of one half.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

_LEAST_VIEWS = 2
"""Where fewer see a point, nothing is known of it."""
_LEVELS = 0.15, 0.6
_SMOOTHING_CELLS = 0.7
_LEAST_SLOPE = 0.05
"""Of the support, a cell: where it is flatter, its level says nothing of the distance."""


def support(
    coverage: Float[np.ndarray, "B H H"], film: Float[np.ndarray, "B N 2"], seen: Bool[np.ndarray, "B N"]
) -> Float[np.ndarray, " N"]:
    """(N,) in [0, 1]; NaN where nothing is known.

    Args:
        coverage: the shape's share of each pixel, in [0, 1].
        film, seen: of the points, see `render.point_views`.
    """
    least = np.ones(film.shape[1])
    for picture, place, visible in zip(coverage, film, seen, strict=True):
        at = ndimage.map_coordinates(picture, [place[:, 1] - 0.5, place[:, 0] - 0.5], order=1, mode="nearest")
        least = np.where(visible, np.minimum(least, at), least)
    return np.where(seen.sum(axis=0) >= _LEAST_VIEWS, least, np.nan)


def explained(
    coverage: Float[np.ndarray, "B H H"], film: Float[np.ndarray, "B N 2"], shown: Bool[np.ndarray, "B N"]
) -> float:
    """The share of the pixels that the shape covers on or next to which a point of the hull lies, in [0, 1].

    Small where the pictures are of no one shape: each of four pairs of antlers is right, and they have no branch in
    common. 0 where the shape covers no pixel by half.

    Args:
        coverage: as in `support`.
        film: of points within the hull and on its surface.
        shown: whether the view sees them.
    """
    found = total = 0
    for picture, place, visible in zip(coverage, film, shown, strict=True):
        rows, columns = (np.floor(place[visible, axis]).astype(int) for axis in (1, 0))
        hit = np.zeros(picture.shape, dtype=bool)
        hit[rows, columns] = True
        covered = picture > 0.5
        found += int((ndimage.binary_dilation(hit) & covered).sum())
        total += int(covered.sum())
    return found / max(total, 1)


def hull_sdf(
    known: Float[np.ndarray, "Z Y X"], free: Bool[np.ndarray, "Z Y X"], empty: Bool[np.ndarray, "Z Y X"]
) -> Float[np.ndarray, "Z Y X"]:
    """Signed distance (Z, Y, X) to the hull in cells, inside positive; everywhere negative where there is none.

    Args:
        known: `support` at a lattice's vertices; NaN: it follows from what is around, and is 0 far from anything known.
        free: where the shape may be.
        empty: of the others, where it is known not to be.
    """
    weight = np.where(empty, 1.0, ~np.isnan(known))
    value = np.where(empty, 0.0, np.nan_to_num(known))
    smooth = ndimage.gaussian_filter(value, _SMOOTHING_CELLS)
    smooth /= np.maximum(ndimage.gaussian_filter(weight, _SMOOTHING_CELLS), 1e-3)
    largest = np.sort(smooth[free])[::-1]
    if not len(largest):
        return np.full(known.shape, -np.inf)
    volume = min(int(np.nansum(known[free])), len(largest) - 1)
    level = float(np.clip(largest[volume], *_LEVELS))
    inside = (smooth > level) & (free | ~empty)
    if not inside.any():
        return np.full(known.shape, -np.inf)
    outer, inner = (np.asarray(ndimage.distance_transform_edt(where)) for where in (~inside, inside))
    distance = np.where(inside, inner - 0.5, 0.5 - outer)
    slope = np.sqrt(sum(np.square(change) for change in np.gradient(smooth)))
    between = np.clip((smooth - level) / np.maximum(slope, _LEAST_SLOPE), -1.5, 1.5)
    return np.where(np.abs(distance) <= 1, between, distance)
