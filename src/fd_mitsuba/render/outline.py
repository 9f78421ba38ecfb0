"""Silhouette edges on the film: projected, and cut off at the picture's border."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.upload import upload_indices
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.mesh_edges import MeshEdges

_NEAREST_DEPTH = 1e-3
"""Edges are cut off where they come nearer to the camera's plane than this."""

_TILE = 4
"""Pixels a side of the tiles by which outline edges are sorted."""

_FIELDS = (((), int), ((2,), int), ((2, 2), float), ((2,), float), ((2,), float), ((2,), float))
"""Shape of a row and type of the fields of `Outline`."""


@dataclass(frozen=True)
class Outline:
    """S clipped silhouette edges, grouped by view; ends 0 and 1 are those of the clipped edge. Lengths are float64."""

    view: np.ndarray
    """(S,) int64, ascending."""
    vertices: np.ndarray
    """(S, 2) int64: the edge's vertices."""
    film: np.ndarray
    """(S, 2, 2) film position of both ends, in pixels."""
    depth: np.ndarray
    """(S, 2)."""
    along: np.ndarray
    """(S, 2) where the clipped ends lie between the vertices: 0 at the first, 1 at the second."""
    outwards: np.ndarray
    """(S, 2) unit vector on the film, across the edge and away from the surface."""


def clip_outline(
    view: np.ndarray, edges: MeshEdges, positions: mi.Float, triangles: mi.UInt32, cameras: FilmCameras
) -> Outline:
    """Cuts edges off at the camera's plane and at the picture's border; drops what is outside, and concave folds.

    All edges of all views are one wavefront, in double precision.

    Args:
        view: (S,) which camera an edge is a silhouette for.
        edges: (S) of the mesh; `half_b` tells in which folds the surface in front hides the edge.
        positions, triangles: the mesh's flat vertices and faces, detached.
    """
    if not len(view):
        return Outline(*(np.zeros((0, *shape), dtype) for shape, dtype in _FIELDS))
    number, half, beside = map(upload_indices, (view, edges.half_a, edges.half_b + 1))
    is_border, beside = beside == 0, dr.maximum(beside, 1) - 1
    right, up, back, eye, half_width = cameras.exactly(number)

    def seen(corner: mi.UInt32) -> mi.Vector3d:
        """The corner in camera space: x to the right, y up, z to the viewer."""
        offset = mi.Vector3d(dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, triangles, corner))) - eye
        return mi.Vector3d(dr.dot(right, offset), dr.dot(up, offset), dr.dot(back, offset))

    next_corner, third_corner = neighbours(half)
    first, second, third, fourth = map(seen, (half, next_corner, third_corner, neighbours(beside)[1]))
    keep = is_border | (dr.dot(dr.cross(second - first, third - first), fourth - first) < 0)

    first_depth, second_depth = -first.z, -second.z
    rise = second_depth - first_depth
    cut = dr.select(rise != 0, (_NEAREST_DEPTH - first_depth) / rise, 0)
    low = dr.select(first_depth < _NEAREST_DEPTH, cut, 0)
    high = dr.select(second_depth < _NEAREST_DEPTH, cut, 1)
    keep &= dr.maximum(first_depth, second_depth) > _NEAREST_DEPTH
    near, far = dr.fma(low, second - first, first), dr.fma(high, second - first, first)
    centre, scale = 0.5 * cameras.size, 0.5 * cameras.size / half_width

    def project(point: mi.Vector3d) -> tuple[mi.Float64, mi.Float64]:
        per_depth = scale / dr.maximum(-point.z, 0.5 * _NEAREST_DEPTH)
        return centre + point.x * per_depth, centre - point.y * per_depth

    start, end = project(near), project(far)
    steps = end[0] - start[0], end[1] - start[1]
    enter, leave = mi.Float64(0), mi.Float64(1)
    for begin, step in zip(start, steps, strict=True):
        # The picture's two pairs of borders, each a range of the edge's parameter on the film.
        level, one, other = step == 0, -begin / step, (cameras.size - begin) / step
        enter = dr.select(level, enter, dr.maximum(enter, dr.minimum(one, other)))
        leave = dr.select(level, leave, dr.minimum(leave, dr.maximum(one, other)))
        keep &= ~level | ((begin >= 0) & (begin <= cameras.size))
    # Across the plane through the camera and the edge; its gradient on the film points to the positive side.
    plane = dr.cross(first, second)
    side, size = dr.dot(plane, third), dr.sqrt(dr.square(plane.x) + dr.square(plane.y))
    keep &= (leave > enter) & (size > 0) & (side != 0)
    # Neighbours on the film become neighbours in the list: rays through the same part of the scene are traced together.
    column, row = (mi.UInt32(dr.clip(place / _TILE + 1, 0, cameras.size + 1)) for place in start)
    tile = (number * (cameras.size + 2) + row) * (cameras.size + 2) + column

    depth_near, depth_far = -near.z, -far.z

    def along(s: mi.Float64) -> tuple[mi.Float64, mi.Float64]:
        t = s * depth_near / (depth_far * (1 - s) + depth_near * s)
        return low + t * (high - low), depth_near + t * (depth_far - depth_near)

    (along_0, depth_0), (along_1, depth_1) = along(enter), along(leave)
    film = [dr.fma(s, step, begin) for s in (enter, leave) for begin, step in zip(start, steps, strict=True)]
    away = dr.select(side > 0, -1, 1) / size
    numbers = [*film, depth_0, depth_1, along_0, along_1, plane.x * away, -plane.y * away]
    vertices = [dr.gather(mi.UInt32, triangles, corner) for corner in (half, next_corner)]
    dr.eval(keep, tile, numbers, vertices)
    kept = np.flatnonzero(np.array(keep))
    kept = kept[np.argsort(np.array(tile)[kept], kind="stable")]
    columns = np.stack([np.array(column)[kept] for column in numbers], axis=1)
    return Outline(
        view[kept],
        np.stack([np.array(column)[kept] for column in vertices], axis=1).astype(np.int64),
        columns[:, :4].reshape(-1, 2, 2),
        *(columns[:, k : k + 2] for k in (4, 6, 8)),
    )


def neighbours(corner: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """The next and the previous corner of the same face."""
    place = corner % 3
    return dr.select(place == 2, corner - 2, corner + 1), dr.select(place == 0, corner + 2, corner - 1)
