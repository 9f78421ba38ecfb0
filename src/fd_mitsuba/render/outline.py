"""Silhouette edges on the film: projected, and cut off at the picture's border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.render.cameras import FilmCameras

_NEAREST_DEPTH = 1e-3
"""Edges are cut off where they come nearer to the camera's plane than this."""

_TILE = 4
"""Pixels a side of the tiles by which outline edges are sorted."""


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
    view: np.ndarray, pair: np.ndarray, opposite: np.ndarray, vertices: np.ndarray, cameras: FilmCameras
) -> Outline:
    """Cuts edges off at the camera's plane and at the picture's border; drops what is outside.

    Args:
        view: (S,) which camera an edge is a silhouette for.
        pair: (S, 2) its vertices.
        opposite: (S,) another vertex of a face beside it, which tells on which side of the edge the surface lies.
        vertices: (V, 3) float32.
    """
    half_width = cameras.half_width[view]
    points = vertices[np.concatenate([pair, opposite[:, None]], axis=1)].astype(np.float64)
    for number in range(cameras.count):  # to camera space, z back; one product a view, not one an edge
        chosen = np.flatnonzero(view == number)
        points[chosen] = (points[chosen] - cameras.position[number]) @ cameras.axes[number].T
    ends, third = points[:, :2], points[:, 2]
    z = -ends[:, :, 2]
    rise = z[:, 1] - z[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.where(rise != 0, (_NEAREST_DEPTH - z[:, 0]) / rise, 0.0)
    low = np.where(z[:, 0] < _NEAREST_DEPTH, cut, 0.0)
    high = np.where(z[:, 1] < _NEAREST_DEPTH, cut, 1.0)
    alive = z.max(axis=1, initial=0.0) > _NEAREST_DEPTH

    def at(t: np.ndarray) -> np.ndarray:
        return ends[:, 0] + t[:, None] * (ends[:, 1] - ends[:, 0])

    near, far = at(low), at(high)
    scale = 0.5 * cameras.size / half_width[:, None]

    def project(point: np.ndarray) -> np.ndarray:
        depth = np.maximum(-point[:, 2:], 0.5 * _NEAREST_DEPTH)
        return 0.5 * cameras.size + point[:, :2] * np.array([1.0, -1.0]) * scale / depth

    start, end = project(near), project(far)
    enter, leave = np.zeros(len(view)), np.ones(len(view))
    for axis in range(2):  # the picture's two pairs of borders, each a range of the edge's parameter on the film
        step = end[:, axis] - start[:, axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = -start[:, axis] / step, (cameras.size - start[:, axis]) / step
        inside = (start[:, axis] >= 0) & (start[:, axis] <= cameras.size)
        level = step == 0
        enter = np.where(level, enter, np.maximum(enter, np.minimum(first, second)))
        leave = np.where(level, leave, np.minimum(leave, np.maximum(first, second)))
        alive &= ~level | inside
    # Across the plane through the camera and the edge; its gradient on the film points to the positive side.
    plane = np.cross(ends[:, 0], ends[:, 1])
    side = np.sign(np.einsum("ni,ni->n", plane, third))
    across = plane[:, :2] * np.array([1.0, -1.0])
    size = np.linalg.norm(across, axis=1)
    keep = np.flatnonzero(alive & (leave > enter) & (size > 0) & (side != 0))
    # Neighbours on the film become neighbours in the list: rays through the same part of the scene are traced together.
    tile = np.clip(start[keep] / _TILE, -1, cameras.size).astype(np.int64)
    keep = keep[np.lexsort((tile[:, 0], tile[:, 1], view[keep]))]
    start, end, enter, leave = start[keep], end[keep], enter[keep, None], leave[keep, None]
    depth_near, depth_far = -near[keep, 2], -far[keep, 2]

    def along(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t = s[:, 0] * depth_near / (depth_far * (1 - s[:, 0]) + depth_near * s[:, 0])
        return low[keep] + t * (high - low)[keep], depth_near + t * (depth_far - depth_near)

    (along_0, depth_0), (along_1, depth_1) = along(enter), along(leave)
    return Outline(
        view=view[keep],
        vertices=pair[keep],
        film=np.stack([start + enter * (end - start), start + leave * (end - start)], axis=1),
        depth=np.stack([depth_0, depth_1], axis=1),
        along=np.stack([along_0, along_1], axis=1),
        outwards=-side[keep, None] * across[keep] / size[keep, None],
    )
