"""Points on outlines in NumPy, every value in double precision: the oracle of `render.outline_points`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.render.outline import Outline


@dataclass(frozen=True)
class PlainPoints:
    """N points on an outline."""

    view: np.ndarray
    """(N,)."""
    vertices: np.ndarray
    """(N, 2)."""
    along: np.ndarray
    """(N,) in [0, 1]: position = (1 - along) first + along second vertex."""
    film: np.ndarray
    """(N, 2)."""
    depth: np.ndarray
    """(N,)."""
    outwards: np.ndarray
    """(N, 2)."""
    length: np.ndarray
    """(N,) film length, in pixels, that a point stands for."""


def plain_points(outline: Outline, views: int, per_view: int, seed: int) -> PlainPoints:
    """Points for every view that has an outline: `per_view` of them, one in each equal stretch of its length.

    View b draws from the random stream of `seed + b`, so that it does not depend on the other views.
    """
    length = np.linalg.norm(outline.film[:, 1] - outline.film[:, 0], axis=1)
    edges, fractions, stretch = [], [], []
    for view in range(views):
        begin, end = np.searchsorted(outline.view, (view, view + 1))
        reach = np.cumsum(length[begin:end])
        if not len(reach) or not reach[-1] > 0:
            continue
        jitter = np.random.Generator(np.random.Philox(key=seed + view)).random(per_view)
        target = (np.arange(per_view) + jitter) * (reach[-1] / per_view)
        edge = np.minimum(np.searchsorted(reach, target, side="right"), len(reach) - 1)
        edges.append(begin + edge)
        own = length[begin:end][edge]
        fractions.append(np.clip((target - (reach[edge] - own)) / np.maximum(own, 1e-300), 0.0, 1.0))
        stretch.append(np.full(per_view, reach[-1] / per_view))
    if not edges:
        nothing = np.zeros(0)
        pairs = np.zeros((0, 2))
        return PlainPoints(nothing.astype(np.int64), pairs.astype(np.int64), nothing, pairs, nothing, pairs, nothing)
    edge, s = np.concatenate(edges), np.concatenate(fractions)
    depth = outline.depth[edge]
    t = s * depth[:, 0] / (depth[:, 1] * (1 - s) + depth[:, 0] * s)  # even on the film is not even in space
    ends = outline.along[edge]
    return PlainPoints(
        view=outline.view[edge],
        vertices=outline.vertices[edge],
        along=ends[:, 0] + t * (ends[:, 1] - ends[:, 0]),
        film=outline.film[edge, 0] + s[:, None] * (outline.film[edge, 1] - outline.film[edge, 0]),
        depth=depth[:, 0] + t * (depth[:, 1] - depth[:, 0]),
        outwards=outline.outwards[edge],
        length=np.concatenate(stretch),
    )
