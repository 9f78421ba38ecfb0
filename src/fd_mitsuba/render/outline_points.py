"""Points on the outlines of all views, drawn evenly along their length on the film."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from fd_mitsuba.backend.upload import upload_doubles, upload_indices
from fd_mitsuba.render.outline import Outline


@dataclass(frozen=True)
class OutlinePoints:
    """N points on an outline, detached."""

    view: mi.UInt32
    vertices: tuple[mi.UInt32, mi.UInt32]
    """Of the edge."""
    along: mi.Float
    """In [0, 1]: position = (1 - along) first + along second vertex."""
    film: mi.Point2f
    depth: mi.Float
    outwards: mi.Vector2f
    length: mi.Float
    """Film length, in pixels, that a point stands for."""

    def __len__(self) -> int:
        return dr.width(self.view)


def sample_outline(outline: Outline, views: int, per_view: int, seed: int) -> OutlinePoints | None:
    """Points for every view that has an outline: `per_view` of them, one in each equal stretch of its length.

    View b draws from the random stream of `seed + b`, so that it does not depend on the other views. None: no view has
    an outline.
    """
    length = np.linalg.norm(outline.film[:, 1] - outline.film[:, 0], axis=1)
    before, stretch = np.zeros(len(length)), np.zeros(len(length))
    edges, targets = [], []
    for view in range(views):
        begin, end = np.searchsorted(outline.view, (view, view + 1))
        reach = np.cumsum(length[begin:end])
        if not len(reach) or not reach[-1] > 0:
            continue
        jitter = np.random.Generator(np.random.Philox(key=seed + view)).random(per_view)
        target = (np.arange(per_view) + jitter) * (reach[-1] / per_view)
        # Both are sorted, and edges are few: how many points each of them has, instead of each point's edge.
        behind = np.searchsorted(target, reach, side="left")
        behind[-1] = per_view
        edges.append(np.repeat(np.arange(begin, end, dtype=np.uint32), np.diff(behind, prepend=0)))
        targets.append(target)
        before[begin:end], stretch[begin:end] = reach - length[begin:end], reach[-1] / per_view
    if not edges:
        return None
    return _placed(outline, np.concatenate(edges), np.concatenate(targets), before, length, stretch)


def _placed(
    outline: Outline,
    edges: np.ndarray,
    targets: np.ndarray,
    before: np.ndarray,
    length: np.ndarray,
    stretch: np.ndarray,
) -> OutlinePoints:
    """The points of given edges at given lengths from the outline's beginning; computed in double precision.

    Args:
        before, length, stretch: of each edge: of all before it in its view, its own, and what a point of it stands for.
    """
    edge, target = upload_indices(edges), upload_doubles(targets)

    def of_edge(values: np.ndarray) -> mi.Float64:
        return dr.gather(mi.Float64, upload_doubles(values), edge)

    def index_of_edge(values: np.ndarray) -> mi.UInt32:
        return dr.gather(mi.UInt32, upload_indices(values), edge)

    s = dr.clip((target - of_edge(before)) / dr.maximum(of_edge(length), 1e-300), 0.0, 1.0)
    near, far = (of_edge(outline.depth[:, end]) for end in (0, 1))
    t = s * near / (far * (1 - s) + near * s)  # even on the film is not even in space
    film = [
        of_edge(outline.film[:, 0, axis]) + s * of_edge(outline.film[:, 1, axis] - outline.film[:, 0, axis])
        for axis in (0, 1)
    ]
    low = of_edge(outline.along[:, 0])
    points = OutlinePoints(
        view=index_of_edge(outline.view),
        vertices=(index_of_edge(outline.vertices[:, 0]), index_of_edge(outline.vertices[:, 1])),
        along=mi.Float(low + t * of_edge(outline.along[:, 1] - outline.along[:, 0])),
        film=mi.Point2f(*map(mi.Float, film)),
        depth=mi.Float(near + t * (far - near)),
        outwards=mi.Vector2f(*(mi.Float(of_edge(outline.outwards[:, axis])) for axis in (0, 1))),
        length=mi.Float(of_edge(stretch)),
    )
    dr.eval(points.view, points.vertices, points.along, points.film, points.depth, points.outwards, points.length)
    return points
