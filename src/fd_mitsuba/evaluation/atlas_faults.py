"""What an atlas does to a part's colour: jumps across its seams, and foreign colours in its small mip levels.

Everything is measured as a renderer sees it: the picture of 8 bits a channel, filtered between its texels, at places on
the mesh. Differences are in steps of such a picture, the largest over its channels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from fd_mitsuba.io.srgb import linear_from_srgb, srgb_from_linear

_ALONG = np.linspace(0.05, 0.95, 7)
_AROUND = 12
_POINTS = 10_000
_WITNESSES = 300
"""So many points or more are asked for the field's colours below one filter."""
Colours = Callable[[np.ndarray], np.ndarray]
"""Points (N, 3), in the frame of the mesh -> the colour (N, 3) that belongs there, in steps of 0 to 255."""


def seam_jumps(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, picture: np.ndarray, truth: Colours) -> dict:
    """How far the two sides of the seams are apart.

    `seams`: edges with two places in the atlas. `jump`: the largest difference between the two. `own`: how much the
    field itself changes within a texel's width there. `beyond_own`: the largest jump less the field's own change there.

    Args:
        vertices: (V, 3), doubled along the seams.
        faces: (F, 3), closed but for that.
        uv: (V, 2), v downwards.
        picture: (S, S, 3) as the file has it, 0 to 255.
        truth: what the picture should show.
    """
    first, second = seam_edges(vertices, faces, uv)
    if not len(first):
        return {"seams": 0, "jump": 0.0, "own": 0.0, "beyond_own": 0.0}
    width = texel_width(vertices, faces, uv, len(picture))
    turns = np.random.default_rng(0).normal(size=(_AROUND, 3))
    turns *= width / np.linalg.norm(turns, axis=1, keepdims=True)
    jumps, own = [], []
    for share in _ALONG:
        point, one, other = (
            values[edge[:, 0]] * (1 - share) + values[edge[:, 1]] * share
            for values, edge in ((vertices, first), (uv, first), (uv, second))
        )
        jumps.append(np.abs(filtered(picture, one) - filtered(picture, other)).max(axis=1))
        near = np.stack([truth(point + turn) for turn in turns])
        own.append(np.ptp(near, axis=0).max(axis=1))
    jump, change = np.concatenate(jumps), np.concatenate(own)
    worst = int(np.argmax(jump - change))
    return {
        "seams": len(first),
        "jump": float(jump.max()),
        "own": float(change[worst]),
        "beyond_own": max(float((jump - change)[worst]), 0.0),
    }


def foreign_colour(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, picture: np.ndarray, truth: Colours, level: int = 3
) -> dict[str, float]:
    """How far a mip level strays, on the surface, from all colours that the field has within the filter's reach.

    The level is made as graphics cards do: means of squares of texels, in linear light. A colour that none of the
    points has that fall below its filter can only come from outside the chart: from a background, or another chart.
    `stray` is the largest such distance, `stray_99` that which 99 % of the points keep below.

    Arguments as of `seam_jumps`.
    """
    small = mip_level(picture, level)
    points, places = _on_surface(vertices, faces, uv, _POINTS, 1)
    width = texel_width(vertices, faces, uv, len(picture))
    reach = 1.5 * 2**level * np.sqrt(2) * width
    share = min(np.pi * reach**2 / _surface_area(vertices, faces), 1.0)
    witnesses = _on_surface(vertices, faces, uv, min(int(_WITNESSES / share), 300_000), 2)[0]
    colours = truth(witnesses)
    shown, own = filtered(small, places), truth(points)
    stray = np.zeros(len(points))
    for number, near in enumerate(KDTree(witnesses).query_ball_point(points, reach, return_sorted=False)):
        there = np.concatenate([colours[near], own[number : number + 1]])
        outside = np.maximum(there.min(axis=0) - shown[number], shown[number] - there.max(axis=0))
        stray[number] = max(float(outside.max()), 0.0)
    return {"stray": float(stray.max()), "stray_99": float(np.quantile(stray, 0.99))}


def seam_edges(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same edges (E, 2) twice, in the vertices of either side, where the atlas has two places for them."""
    _, corner = np.unique(vertices, axis=0, return_inverse=True)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    joined = corner.reshape(-1)[edges]
    order = np.argsort(joined, axis=1)
    edges, joined = np.take_along_axis(edges, order, axis=1), np.take_along_axis(joined, order, axis=1)
    by_edge = np.lexsort((joined[:, 1], joined[:, 0]))
    first, second = edges[by_edge[0::2]], edges[by_edge[1::2]]
    if len(edges) % 2 or not np.array_equal(joined[by_edge[0::2]], joined[by_edge[1::2]]):
        raise ValueError("the mesh is not closed")
    apart = np.any(uv[first] != uv[second], axis=(1, 2))
    return first[apart], second[apart]


def filtered(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The picture (H, W, C) between its texels at uv (N, 2), v downwards, clamped at its border: (N, C)."""
    height, width = picture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right_share, low_share = (x - left)[:, None], (y - top)[:, None]

    def texel(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        return picture[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float64)

    upper = texel(top, left) * (1 - right_share) + texel(top, left + 1) * right_share
    lower = texel(top + 1, left) * (1 - right_share) + texel(top + 1, left + 1) * right_share
    return upper * (1 - low_share) + lower * low_share


def mip_level(picture: np.ndarray, level: int) -> np.ndarray:
    """A colour picture (S, S, 3) in sRGB, 0 to 255, halved `level` times, S a multiple of 2 to that power."""
    share = np.asarray(picture, dtype=np.float64) / 255
    linear = linear_from_srgb(share)
    for _ in range(level):
        linear = (linear[0::2, 0::2] + linear[1::2, 0::2] + linear[0::2, 1::2] + linear[1::2, 1::2]) / 4
    return srgb_from_linear(linear) * 255


def texel_width(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, size: int) -> float:
    """How wide a texel is on the surface, in the mesh's unit, on the whole."""
    flat = uv[faces]
    first, second = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    share = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() / 2
    return float(np.sqrt(_surface_area(vertices, faces) / share)) / size


def _surface_area(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces]
    return float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    )


def _on_surface(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, count: int, seed: int) -> Any:
    """Points (N, 3) spread evenly over the surface, and their places (N, 2) in the atlas."""
    random = np.random.default_rng(seed)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = random.choice(len(faces), size=count, p=area / area.sum())
    weights = random.dirichlet([1.0, 1.0, 1.0], size=count)
    return tuple(np.einsum("nk,nkc->nc", weights, values[faces[face]]) for values in (vertices, uv))
