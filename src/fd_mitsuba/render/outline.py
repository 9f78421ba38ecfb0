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
    parts = []
    for number in range(cameras.count):
        chosen = np.flatnonzero(view == number)
        parts.append(_clip_view(number, pair[chosen], opposite[chosen], vertices, cameras))
    return Outline(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _clip_view(
    number: int, pair: np.ndarray, opposite: np.ndarray, vertices: np.ndarray, cameras: FilmCameras
) -> tuple[np.ndarray, ...]:
    """The fields of `Outline` for one camera. Coordinates are rows here, x, y and z: NumPy is faster that way."""

    def camera_space(index: np.ndarray) -> np.ndarray:
        return cameras.axes[number] @ (vertices[index] - cameras.position[number]).T

    first, second, third = camera_space(pair[:, 0]), camera_space(pair[:, 1]), camera_space(opposite)
    first_depth, second_depth = -first[2], -second[2]
    rise = second_depth - first_depth
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = np.where(rise != 0, (_NEAREST_DEPTH - first_depth) / rise, 0.0)
    low = np.where(first_depth < _NEAREST_DEPTH, cut, 0.0)
    high = np.where(second_depth < _NEAREST_DEPTH, cut, 1.0)
    alive = np.maximum(first_depth, second_depth) > _NEAREST_DEPTH
    edge = second - first
    near, far = first + low * edge, first + high * edge
    centre, scale = 0.5 * cameras.size, 0.5 * cameras.size / cameras.half_width[number]

    def project(point: np.ndarray) -> np.ndarray:
        per_depth = scale / np.maximum(-point[2], 0.5 * _NEAREST_DEPTH)
        return np.stack([centre + point[0] * per_depth, centre - point[1] * per_depth])

    start, end = project(near), project(far)
    enter, leave = np.zeros(len(pair)), np.ones(len(pair))
    for begin, step in zip(start, end - start, strict=True):
        # The picture's two pairs of borders, each a range of the edge's parameter on the film.
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = -begin / step, (cameras.size - begin) / step
        level = step == 0
        enter = np.where(level, enter, np.maximum(enter, np.minimum(one, other)))
        leave = np.where(level, leave, np.minimum(leave, np.maximum(one, other)))
        alive &= ~level | ((begin >= 0) & (begin <= cameras.size))
    # Across the plane through the camera and the edge; its gradient on the film points to the positive side.
    plane = np.stack([first[k - 2] * second[k - 1] - first[k - 1] * second[k - 2] for k in range(3)])
    side = np.sign(plane[0] * third[0] + plane[1] * third[1] + plane[2] * third[2])
    size = np.sqrt(plane[0] ** 2 + plane[1] ** 2)
    keep = np.flatnonzero(alive & (leave > enter) & (size > 0) & (side != 0))
    # Neighbours on the film become neighbours in the list: rays through the same part of the scene are traced together.
    tile = np.clip(start[:, keep] / _TILE, -1, cameras.size).astype(np.int64)
    keep = keep[np.argsort(tile[1] * (cameras.size + 2) + tile[0], kind="stable")]
    start, step, enter, leave = start[:, keep], (end - start)[:, keep], enter[keep], leave[keep]
    depth_near, depth_far, low, span = -near[2, keep], -far[2, keep], low[keep], (high - low)[keep]

    def along(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t = s * depth_near / (depth_far * (1 - s) + depth_near * s)
        return low + t * span, depth_near + t * (depth_far - depth_near)

    (along_0, depth_0), (along_1, depth_1) = along(enter), along(leave)
    outwards = np.stack([plane[0, keep], -plane[1, keep]], axis=1) * (-side[keep] / size[keep])[:, None]
    return (
        np.full(len(keep), number, dtype=np.int64),
        pair[keep],
        np.stack([(start + enter * step).T, (start + leave * step).T], axis=1),
        np.stack([depth_0, depth_1], axis=1),
        np.stack([along_0, along_1], axis=1),
        outwards,
    )
