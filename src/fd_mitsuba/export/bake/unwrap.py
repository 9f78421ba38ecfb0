"""A UV atlas of a mesh: every face gets its own place in the unit square, with a gutter around each chart.

    charts    `wide_charts` (few), or xatlas (any mesh)           which faces lie together, and where the seams are
    flat      the same                                            each chart laid flat, in the mesh's own unit
    notches   `open_notches`, `crowded`                           places where a texel would belong to two of its faces
    packed    `packed_charts` (few), or xatlas                    all charts in the unit square, with gutters
    left out  `place_left_out`                                    faces without an area, which xatlas packs nowhere

What travels through these steps is a triple: `vertex_map` (S,) says which vertex each split vertex was, `split` (F, 3)
are the faces in split vertices, and `flat` or `uv` (S, 2) where those lie. A vertex on a seam is there once a chart.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import xatlas

from fd_mitsuba.export.bake.chart_notches import charts_of, open_notches
from fd_mitsuba.export.bake.chart_packing import likely_density, packed_charts
from fd_mitsuba.export.bake.wide_charts import wide_charts
from fd_mitsuba.scene.vertex_normals import vertex_normals

_FACES_AT_ONCE = 2500
"""xatlas grows charts in more than linear time: pieces of this size are quicker, and give fewer charts."""
_FEW_CHARTS = 100
"""So many charts are laid one by one; more would take too long."""
_PACKINGS = 6
"""Densities that are tried until xatlas's packing is as large as the texture; it takes a wish, not a size."""
_LONGEST = 1000.0
"""The size that xatlas sees: it takes triangles below 1e-7 in area for nothing, which slivers of a unit mesh are."""


@dataclass(frozen=True)
class UnwrappedMesh:
    """A mesh whose vertices are split along the atlas's seams; faces keep their number, order and corners' positions.

    Attributes:
        vertices: (V, 3) float64, in the frame of the input.
        faces: (F, 3) int64.
        normals: (V, 3) float64 unit, equal on both sides of a seam.
        uv: (V, 2) float64 in [0, 1], origin in the picture's top left corner and v downwards, as in glTF and Mitsuba.
            A chart seen in the picture is as seen from outside, never mirrored.
        vertex_map: (V,) int64, the input vertex that each vertex comes from.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    vertex_map: np.ndarray


def padding_for(texture_size: int) -> int:
    """Texels between charts: from 1024 texels a side on, as much as a texel of mip level 3 is wide."""
    return max(2, texture_size // 128)


def unwrap(
    vertices: np.ndarray, faces: np.ndarray, texture_size: int, normals: np.ndarray | None = None
) -> UnwrappedMesh:
    """The atlas of a mesh, vertices (V, 3) and faces (F, 3), for a square texture of `texture_size` texels a side.

    The same input gives the same atlas.

    Args:
        normals: (V, 3) unit; None: those of the faces around each vertex.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    faces = np.asarray(faces, dtype=np.int64)
    vertex_map, split, flat = _charts(vertices, faces, texture_size)
    density = likely_density(flat, split, texture_size)
    vertex_map, split, flat = open_notches(vertices, vertex_map, split, flat, density)
    uv = _packed(flat, split, texture_size)
    vertex_map, split, uv = place_left_out(vertices, vertex_map, split, uv)
    uv[:, 1] = 1.0 - uv[:, 1]  # xatlas has v upwards
    if normals is None:
        normals = vertex_normals(vertices, faces)
    return UnwrappedMesh(vertices[vertex_map], split, normals[vertex_map], np.clip(uv, 0, 1), vertex_map)


def _charts(vertices: np.ndarray, faces: np.ndarray, texture_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex map, split faces, and a place (V, 2) of each split vertex in the vertices' unit; charts do not overlap.

    Few, wide charts where the surface is closed and even enough for that; else xatlas's.
    """
    return wide_charts(vertices, faces, texture_size) or _xatlas_charts(vertices, faces)


def _xatlas_charts(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    centred = vertices - vertices.mean(axis=0)  # xatlas works in float32
    longest = float(np.abs(centred).max()) or 1.0
    atlas = xatlas.Atlas()
    pieces = _pieces(centred[faces].mean(axis=1), np.arange(len(faces)))
    used = []
    for piece in pieces:
        indices, local = np.unique(faces[piece], return_inverse=True)
        used.append(indices)
        atlas.add_mesh(
            (centred[indices] / longest * _LONGEST).astype(np.float32), local.reshape(-1, 3).astype(np.uint32)
        )
    charting, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charting.fix_winding = True
    packing.rotate_charts = False  # it would mirror the chart
    packing.resolution = 256  # a coarse first packing: only the charts' shapes count here
    atlas.generate(charting, packing)
    size = np.array([atlas.width, atlas.height]) / atlas.texels_per_unit * (longest / _LONGEST)
    split, vertex_map, flat, count = np.empty_like(faces), [], [], 0
    for number, piece in enumerate(pieces):
        origin, local, uv = atlas.get_mesh(number)
        split[piece] = local.astype(np.int64) + count
        vertex_map.append(used[number][origin.astype(np.int64)])
        flat.append(uv.astype(np.float64) * size)
        count += len(origin)
    return np.concatenate(vertex_map), split, np.concatenate(flat)


def place_left_out(
    vertices: np.ndarray, vertex_map: np.ndarray, faces: np.ndarray, uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex map, faces and UVs with a place for the faces that xatlas packed nowhere, since they have no area.

    It leaves all their corners at 0, where any chart may lie. Here such a face goes to the edge of the chart that most
    of its corners belong to; a corner that does not takes the place of the nearest one that does.

    Args:
        vertices: (V, 3), before the charts were split.
        vertex_map: (S,), split vertex -> vertex.
        faces: (F, 3) in split vertices.
        uv: (S, 2) in any unit.
    """
    out = np.flatnonzero(np.all(uv[faces] == 0, axis=(1, 2)))
    placed = np.delete(faces, out, axis=0)
    if not len(out) or not len(placed):
        return vertex_map, faces, uv
    chart = charts_of(placed, len(uv))
    twins: dict[int, dict[int, int]] = {}  # vertex -> chart -> split vertex
    for split in np.unique(placed):
        twins.setdefault(int(vertex_map[split]), {})[int(chart[split])] = int(split)
    faces, more_map, more_uv = faces.copy(), [], []
    for face in out:
        corners = vertex_map[faces[face]]
        known = [twins.get(int(corner), {}) for corner in corners]
        counts = Counter(number for each in known for number in each)
        if not counts:  # amid others of its kind
            nearest = min(twins, key=lambda vertex: float(np.linalg.norm(vertices[vertex] - vertices[corners[0]])))
            corners, known = np.append(corners, nearest), [*known, twins[nearest]]
            counts = Counter(twins[nearest].keys())
        best = counts.most_common(1)[0][0]
        inside = [k for k in range(len(known)) if best in known[k]]
        for corner in corners[:3]:
            away = np.linalg.norm(vertices[corners[inside]] - vertices[corner], axis=1)
            near = inside[int(np.argmin(away))]
            more_map.append(corner)
            more_uv.append(uv[known[near][best]])
        faces[face] = len(uv) + len(more_uv) + np.array([-3, -2, -1])
    used, faces = np.unique(faces, return_inverse=True)
    vertex_map = np.concatenate([vertex_map, np.array(more_map, dtype=np.int64)])[used]
    return vertex_map, faces.reshape(-1, 3), np.concatenate([uv, np.array(more_uv).reshape(-1, 2)])[used]


def _pieces(centres: np.ndarray, chosen: np.ndarray) -> list[np.ndarray]:
    if len(chosen) <= _FACES_AT_ONCE:
        return [chosen]
    axis = int(np.argmax(np.ptp(centres[chosen], axis=0)))
    order = chosen[np.argsort(centres[chosen, axis], kind="stable")]
    middle = len(order) // 2
    return _pieces(centres, np.sort(order[:middle])) + _pieces(centres, np.sort(order[middle:]))


def _packed(flat: np.ndarray, faces: np.ndarray, texture_size: int) -> np.ndarray:
    """The charts packed into the unit square, as large as they fit with the gutter that the texture needs.

    Few charts are laid one by one. With more, xatlas packs them; it only comes near a wanted size, and the gutter would
    shrink with the rest.
    """
    chart = charts_of(faces, len(flat))
    left_out = np.all(flat[faces] == 0, axis=(1, 2)).any()  # see `place_left_out`
    if chart.max() < _FEW_CHARTS and not left_out:
        laid = packed_charts(flat, faces, chart, texture_size, padding_for(texture_size))
        if laid is not None:
            return laid
    density = likely_density(flat, faces, texture_size)
    best, last, best_density, upper = None, flat, 0.0, np.inf
    for _ in range(_PACKINGS):
        uv, size = _pack(flat, faces, density, padding_for(texture_size))
        last = uv / max(size, 1)
        if size <= texture_size:
            best, best_density = uv / texture_size, density
            if size > 0.97 * texture_size:
                break
        else:
            upper = density
        wanted = density * (0.985 * texture_size / size)
        inside = best_density < wanted < upper
        density = wanted if inside else (best_density + upper) / 2 if np.isfinite(upper) and best_density else wanted
    # Many tiny charts: the gutters alone fill the texture. Rather a thinner gutter than none of the faces.
    return best if best is not None else last


def _pack(flat: np.ndarray, faces: np.ndarray, density: float, padding: int) -> tuple[np.ndarray, int]:
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    # In texels, so that xatlas's bounds for what has no area do not depend on the unit.
    atlas.add_uv_mesh((flat * density).astype(np.float32), faces.astype(np.uint32))
    packing.padding, packing.rotate_charts, packing.texels_per_unit = padding, False, 1.0
    atlas.generate(xatlas.ChartOptions(), packing)
    origin, packed_faces, uv = atlas.get_mesh(0)
    texels = np.zeros_like(flat)
    texels[faces.ravel()] = (uv.astype(np.float64) * [atlas.width, atlas.height])[packed_faces.astype(np.int64).ravel()]
    return texels, max(atlas.width, atlas.height)
