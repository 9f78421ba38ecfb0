"""Few, wide charts of a closed, even mesh, each laid flat: those of `grown_charts`, cut in two until all lie flat.

Where more are left than an atlas is to have, the smallest are joined to a neighbour that lies flat together with them.
"""

from __future__ import annotations

import numpy as np

from fd_mitsuba.export.bake.chart_growth import grown_charts, split_chart
from fd_mitsuba.export.bake.chart_notches import crowded
from fd_mitsuba.export.bake.chart_packing import likely_density
from fd_mitsuba.export.bake.flatten import NotFlat, flattened, pinched_apart
from fd_mitsuba.export.final_surface.mesh_rings import Edges, edges_of

_FEWEST = 400
"""Faces that a mesh must have for charts of our own."""
_ROUNDS, _TRIES = 3, 40
"""How often charts with narrow notches are cut in two, and how many may not lie flat before all is left to xatlas."""
_WANTED, _NEIGHBOURS = 36, 3
"""With more charts than that, the smallest are joined to one of so many neighbours, where that lies flat."""


def wide_charts(
    vertices: np.ndarray, faces: np.ndarray, texture_size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Vertex map (S,), split faces (F, 3) and places (S, 2) in the mesh's unit; see `unwrap`. Charts do not overlap.

    None where the mesh is small or open, or where too many of its charts do not lie flat.

    Args:
        vertices: (V, 3). faces: (F, 3).
        texture_size: texels a side of the texture, to tell where a notch would be narrower than a texel.
    """
    if len(faces) < _FEWEST:
        return None
    try:
        edges = edges_of(faces, len(vertices))
    except ValueError:
        return None
    chart = grown_charts(vertices, faces, edges)
    laid: dict[int, tuple[np.ndarray, ...]] = {}  # its faces, the same in its own vertices, which these are, places
    tries, found = 0, None
    for turn in range(_ROUNDS):
        waiting = [number for number in np.unique(chart).tolist() if number not in laid]
        while waiting:
            number = waiting.pop()
            own = np.flatnonzero(chart == number)
            local, used = pinched_apart(faces[own])
            try:
                laid[number] = own, local, used, flattened(vertices[used], local)
            except NotFlat as bad:
                tries += 1
                if tries > _TRIES or len(own) < 2:
                    return None
                apart = None if bad.apart is None else (int(own[bad.apart[0]]), int(own[bad.apart[1]]))
                waiting += [number, int(chart.max()) + 1]
                chart = split_chart(vertices, faces, edges, chart, number, apart)
        vertex_map, split, flat = found = _side_by_side(faces, laid)
        narrow = crowded(vertices[vertex_map], split, flat, likely_density(flat, split, texture_size))
        if not len(narrow) or turn == _ROUNDS - 1:
            break
        for one, other in narrow.tolist():
            number = int(chart[one])
            if number in laid and chart[other] == number:  # of each chart the worst place first
                chart = split_chart(vertices, faces, edges, chart, number, (one, other))
                del laid[number]
    if found is not None and len(laid) > _WANTED:
        density = likely_density(found[2], found[1], texture_size)
        found = _side_by_side(faces, _joined(vertices, faces, edges, chart, laid, density))
    return found


def _joined(
    vertices: np.ndarray,
    faces: np.ndarray,
    edges: Edges,
    chart: np.ndarray,
    laid: dict[int, tuple[np.ndarray, ...]],
    density: float,
) -> dict[int, tuple[np.ndarray, ...]]:
    """The charts with small ones joined to a neighbour where both lie flat together, until few enough are left."""
    chart, laid = chart.copy(), dict(laid)
    for number in sorted(laid, key=lambda x: len(laid[x][0])):
        if len(laid) <= _WANTED:
            break
        near = chart[edges.faces]
        across = (near == number).sum(axis=1) == 1
        others, border = np.unique(near[across].sum(axis=1) - number, return_counts=True)
        for other in others[np.argsort(-border, kind="stable")][:_NEIGHBOURS].tolist():
            own = np.flatnonzero((chart == number) | (chart == other))
            local, used = pinched_apart(faces[own])
            try:
                flat = flattened(vertices[used], local)
            except NotFlat:
                continue
            if not len(crowded(vertices[used], local, flat, density)):
                laid[other] = own, local, used, flat
                chart[own] = other
                del laid[number]
                break
    return laid


def _side_by_side(
    faces: np.ndarray, laid: dict[int, tuple[np.ndarray, ...]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex map, split faces and places of charts, none of which overlaps another."""
    split, vertex_map, places, count, corner = np.empty_like(faces), [], [], 0, 0.0
    for own, local, used, flat in laid.values():
        split[own] = local + count
        vertex_map.append(used)
        places.append(flat - flat.min(axis=0) + [corner, 0.0])
        corner += float(np.ptp(flat[:, 0])) * 1.1
        count += len(used)
    return np.concatenate(vertex_map), split, np.concatenate(places)
