"""How far a point is from where the part is seen to stand on the base: smooth, so that the joint is a smooth curve.

The field of a part is no distance outside of it, and inside the base no loss ever saw it. What it says there shows in
the joint: lobes over what lies hidden just below the base, teeth where the field falls slowly. Here only what can be
seen counts, and only as a distance:

    raw(x) = the distance to the part's surface outside of the base, negative in the part;
             inside the base that of the nearest point on the base, so that nothing hidden there matters
    a      = raw, averaged with a Gaussian

A level line of `a` on the base is the joint: closed, and without a kink where two prongs are equally near.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from fd_mitsuba.export.final_surface.spline import LatticeSpline
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.scene.mesh_distance import MeshDistance

_FINER = 2
_BAND_CELLS = 3.5
"""Values are exact so far from the base, in cells of the training; the fillet and the sink are half as wide."""
_FAR_CELLS = 4.0
"""Distances are cut off here, or so far beyond the rim: further out there is no solid any more."""
_BEYOND_RIM_CELLS = 2.5
_SMOOTH_CELLS = 0.9
"""Standard deviation of the Gaussian. The joint lies further than this from what makes it."""


def contact_of(
    grid: TetGrid,
    base_lattice: np.ndarray,
    part_lattice: np.ndarray,
    base: MeshDistance,
    surface: tuple[np.ndarray, np.ndarray],
    in_part: Callable[[np.ndarray], np.ndarray],
    reach: float,
) -> LatticeSpline | None:
    """The smoothed distance `a` from the contact of a part with the base; None where they do not come near each other.

    Args:
        base_lattice: (z, y, x) base sdf at the grid's vertices.
        part_lattice: (z, y, x) the part's.
        surface: vertices (V, 3) and faces (F, 3) of the part's own surface, closed.
        in_part: points (N, 3) -> whether they are in the part.
        reach: the joint is where `a` has this value.
    """
    cell = grid.spacing
    far = max(_FAR_CELLS * cell, reach + _BEYOND_RIM_CELLS * cell)
    seen = _outside(*surface, base)
    reached = np.abs(base_lattice) < (_BAND_CELLS + 1) * cell
    if part_lattice.max() > 0:
        apart = np.asarray(ndimage.distance_transform_edt(part_lattice <= 0, sampling=cell))
        reached &= apart < far + 2 * cell
    if seen is None or not reached.any():
        return None
    bounds = [slice(max(s.start - 1, 0), s.stop + 1) for s in ndimage.find_objects(reached.astype(np.int8))[0]]
    marked = np.kron(reached[tuple(bounds)], np.ones((_FINER,) * 3, dtype=bool))
    step = cell / _FINER
    origin = grid.axis.numpy()[[bounds[axis].start for axis in (2, 1, 0)]].astype(np.float64)
    index = np.flatnonzero(marked)
    z, y, x = np.unravel_index(index, marked.shape)
    points = origin + step * np.stack([x, y, z], axis=1)
    inside = base.inside(points)
    points[inside] = base.feet(points[inside])
    distance = np.minimum(seen.unsigned(points), far)
    raw = np.zeros(marked.shape)
    raw.reshape(-1)[index] = np.where(in_part(points), -distance, distance)
    nearest = np.asarray(ndimage.distance_transform_edt(~marked, return_distances=False, return_indices=True))
    smooth = ndimage.gaussian_filter(raw[tuple(nearest)], _SMOOTH_CELLS * _FINER, mode="nearest")
    return LatticeSpline.through(smooth, origin, step)


def _outside(vertices: np.ndarray, faces: np.ndarray, base: MeshDistance) -> MeshDistance | None:
    """What of a surface is outside of the base, cut along it; None if nothing is."""
    depth = base.signed(vertices)
    out = depth < 0
    count = out[faces].sum(axis=1)
    pieces = [vertices[faces[count == 3]]]
    for number in (1, 2):
        # Each face turned so that the corner which is alone on its side comes first.
        rows = faces[count == number]
        alone = np.argmax(out[rows] == (number == 1), axis=1)
        rows = np.take_along_axis(rows, (alone[:, None] + np.arange(3)) % 3, axis=1)
        corner, level = vertices[rows], depth[rows]
        share = level[:, :1] / (level[:, :1] - level[:, 1:])
        cut = corner[:, :1] + share[..., None] * (corner[:, 1:] - corner[:, :1])
        if number == 1:
            pieces.append(np.concatenate([corner[:, :1], cut], axis=1))
        else:
            pieces.append(np.stack([cut[:, 0], corner[:, 1], corner[:, 2]], axis=1))
            pieces.append(np.stack([cut[:, 0], corner[:, 2], cut[:, 1]], axis=1))
    corners = np.concatenate(pieces)
    if not len(corners):
        return None
    return MeshDistance(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
