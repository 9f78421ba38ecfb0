"""A closed surface cut into few charts: compact, without holes, and none that bends so far that it could not lie flat.

Faces are points in six dimensions, their middle and a multiple of their normal. A chart is what is nearer to its seed
than to any other along the surface, so that it stretches along flat places and stops where the surface turns.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from fd_mitsuba.export.final_surface.mesh_rings import Edges, cross_of_faces

_FIRST, _MOST = 10, 22
"""Charts at first, and at most: each chart costs a gutter, each one too few a distorted or overlapping one."""
_WIDEST = 85.0
"""Degrees between a chart's mean normal and any of its faces: beyond it another seed is set."""
_MOVES = 3
"""Times that the seeds are moved to their charts' middles, as in Lloyd's algorithm, before more are set."""
_SMALLEST = 0.004
"""Share of the surface below which a chart is joined to another, if that stays a disc."""


def grown_charts(vertices: np.ndarray, faces: np.ndarray, edges: Edges) -> np.ndarray:
    """The chart (F,) of each face of a closed mesh, each a disc or what more seeds did not make one."""
    cross = cross_of_faces(vertices, faces)
    area = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(area, 1e-30)[:, None]
    # A chart as round as it can be bends by 90 degrees as far from its middle as it reaches.
    weight = np.sqrt(area.sum() / 2 / (np.pi * _FIRST)) / (np.pi / 2)
    places = np.concatenate([vertices[faces].mean(axis=1), weight * normal], axis=1)
    one, other = edges.faces.T
    length = np.linalg.norm(places[one] - places[other], axis=1) + 1e-12
    graph = csr_array(coo_array((length, (one, other)), shape=(len(faces),) * 2))
    seeds = _spread(graph, area)
    chart, distance = _nearest(graph, seeds)
    for _ in range(_MOST):
        for _ in range(_MOVES):
            seeds = _centred(places, area, chart, len(seeds))
            chart, distance = _nearest(graph, seeds)
        bad = _bad(faces, edges, normal, area, chart, len(seeds))
        room = _MOST - len(seeds)
        if not len(bad) or room <= 0:
            break
        seeds = np.concatenate([seeds, [_farthest(chart, distance, number) for number in bad[: max(room, 1)]]])
        chart, distance = _nearest(graph, seeds)
    return _smoothed(edges, faces, _merged(edges, faces, area, chart))


def split_chart(
    vertices: np.ndarray,
    faces: np.ndarray,
    edges: Edges,
    chart: np.ndarray,
    number: int,
    apart: tuple[int, int] | None = None,
) -> np.ndarray:
    """The charts with one of them cut in two.

    Args:
        apart: two of its faces that are to be in different halves; None: those at the ends of its longer side.
    """
    own = np.flatnonzero(chart == number)
    middles = vertices[faces[own]].mean(axis=1)
    inside = (chart[edges.faces] == number).all(axis=1)
    place = np.full(len(faces), -1)
    place[own] = np.arange(len(own))
    if apart is None:
        axis = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)[2][0]
        along = middles @ axis
        seeds = np.array([np.argmin(along), np.argmax(along)])
    else:
        seeds = place[list(apart)]
    one, other = place[edges.faces[inside]].T
    length = np.linalg.norm(middles[one] - middles[other], axis=1) + 1e-12
    graph = csr_array(coo_array((length, (one, other)), shape=(len(own),) * 2))
    halves, _ = _nearest(graph, seeds)
    chart = chart.copy()
    chart[own[halves == 1]] = chart.max() + 1
    return chart


def euler_numbers(faces: np.ndarray, edges: Edges, chart: np.ndarray, count: int) -> np.ndarray:
    """Vertices minus edges plus faces of each of `count` charts: 1 for a disc."""
    corners = np.unique(faces.reshape(-1) * count + np.repeat(chart, 3)) % count
    sides = np.unique(edges.face_edges.reshape(-1) * count + np.repeat(chart, 3)) % count
    return sum(sign * np.bincount(x, minlength=count) for sign, x in ((1, corners), (-1, sides), (1, chart)))  # type: ignore[return-value]


def _spread(graph: csr_array, area: np.ndarray) -> np.ndarray:
    """Seeds far from each other, one a piece of the surface at least."""
    seeds = [int(np.argmax(area))]
    distance = dijkstra(graph, directed=False, indices=seeds[0])
    while len(seeds) < _FIRST or np.isinf(distance).any():
        seeds.append(int(np.argmax(distance)))
        distance = np.minimum(distance, dijkstra(graph, directed=False, indices=seeds[-1]))
    return np.array(seeds)


def _nearest(graph: csr_array, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The place in `seeds` of the nearest one, (F,), and how far it is."""
    distance, _, source = dijkstra(graph, directed=False, indices=seeds, min_only=True, return_predecessors=True)
    number = np.full(len(distance), 0)
    number[seeds] = np.arange(len(seeds))
    return number[source], distance


def _centred(places: np.ndarray, area: np.ndarray, chart: np.ndarray, count: int) -> np.ndarray:
    """Per chart the face next to its middle."""
    total = np.maximum(np.bincount(chart, area, count), 1e-300)
    middle = np.stack([np.bincount(chart, area * x, count) / total for x in places.T], axis=1)
    away = np.linalg.norm(places - middle[chart], axis=1)
    order = np.lexsort((away, chart))
    return order[np.searchsorted(chart[order], np.arange(count))]


def _bad(
    faces: np.ndarray, edges: Edges, normal: np.ndarray, area: np.ndarray, chart: np.ndarray, count: int
) -> np.ndarray:
    """Charts that are no discs, or bend too far: the worst first."""
    mean = np.stack([np.bincount(chart, area * x, count) for x in normal.T], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-30)
    turned = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normal, mean[chart]), -1, 1)))
    order = np.lexsort((turned, chart))
    ends = np.searchsorted(chart[order], np.arange(count), side="right")
    # A few slivers may look anywhere.
    widest = turned[order][ends - 1 - (np.bincount(chart, minlength=count) // 50)]
    score = widest + 1000 * (euler_numbers(faces, edges, chart, count) != 1)
    worst = np.argsort(-score, kind="stable")
    return worst[score[worst] > _WIDEST]


def _farthest(chart: np.ndarray, distance: np.ndarray, number: int) -> int:
    own = np.flatnonzero(chart == number)
    return int(own[np.argmax(distance[own])])


def _merged(edges: Edges, faces: np.ndarray, area: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """Charts too small to be worth a gutter joined to the neighbour that they share most of their border with."""
    chart = chart.copy()
    for number in np.argsort(np.bincount(chart, area), kind="stable").tolist():
        own = chart == number
        if area[own].sum() > _SMALLEST * area.sum():
            break
        near = chart[edges.faces]
        across = (near == number).sum(axis=1) == 1
        other = np.where(near[across, 0] == number, near[across, 1], near[across, 0])
        for neighbour in np.argsort(-np.bincount(other, minlength=1), kind="stable")[: len(np.unique(other))].tolist():
            tried = np.where(own, neighbour, chart)
            count = int(chart.max()) + 1
            if euler_numbers(faces, edges, tried, count)[neighbour] == 1:
                chart = tried
                break
    return np.unique(chart, return_inverse=True)[1]


def _smoothed(edges: Edges, faces: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """Charts without teeth along their borders, as long as they stay discs."""
    count = int(chart.max()) + 1
    sides = edges.faces[edges.face_edges]
    beside = np.where(sides[..., 0] == np.arange(len(faces))[:, None], sides[..., 1], sides[..., 0])
    before = euler_numbers(faces, edges, chart, count)
    for turn in range(6):  # half of the faces at a time: neighbours that moved together would only swap their teeth
        near = chart[beside]
        a, b, c = near.T
        pair = np.where(a == b, a, np.where(b == c, b, c))
        agree = (near == pair[:, None]).sum(axis=1) >= 2
        moves = agree & (pair != chart) & ((np.arange(len(faces)) + turn) % 2 == 0)
        tried = np.where(moves, pair, chart)
        spoilt = euler_numbers(faces, edges, tried, count) != before
        tried = np.where(spoilt[chart] | spoilt[tried], chart, tried)
        if (euler_numbers(faces, edges, tried, count) == before).all():
            chart = tried
    return chart
