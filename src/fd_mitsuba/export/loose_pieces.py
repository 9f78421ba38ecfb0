"""Pieces of a mesh that a cut has left without a hold, such as the tip of a horn that stands out of a region.

Looked for within each body of the mesh, so among what was one connected surface before; the largest piece of a body is
never loose, nor is one that touches or is buried in anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.scene.mesh_distance import MeshDistance

CRUMB_SHARE = 0.25
"""Of the volume that was cut out: a loose piece up to that goes with it."""
_TOUCH = 1e-6
"""Of the size of all: two surfaces so near touch."""
Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class LoosePieces:
    """Attributes:
    crumb: (F,) bool, faces of small pieces, which shall go.
    solids: these pieces.
    large: how many larger ones there are.
    """

    crumb: np.ndarray
    solids: tuple[Solid, ...]
    large: int


def bodies(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The connected surface, counted from 0, that each face (F,) belongs to; equal positions are one vertex."""
    rows, weld = np.unique(np.asarray(vertices) + 0.0, axis=0, return_inverse=True)
    return Solid(rows, weld.reshape(-1)[faces]).pieces()


def loose_pieces(
    vertices: np.ndarray, faces: np.ndarray, body: np.ndarray, others: Sequence[Mesh], removed: float
) -> LoosePieces:
    """What hangs free of a mesh after a cut.

    Args:
        vertices, faces: (V, 3), (F, 3) what is left of it; the walls of cavities look inwards.
        body: (F,) which of the `bodies` before the cut a face is of, -1 for faces that the cut has made.
        others: vertices and faces of what stands beside it, in the same frame.
        removed: the volume that was cut out of it.
    """
    piece, crumb, solids, large = bodies(vertices, faces), np.zeros(len(faces), dtype=bool), [], 0
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = np.bincount(piece, np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)
    cut, candidates = np.bincount(piece, body < 0) > 0, []
    for own in np.unique(body[(body >= 0) & cut[piece]]):
        parts = np.unique(piece[body == own])
        candidates += sorted(parts[volume[parts] > 0], key=lambda part: -volume[part])[1:]
    if not candidates:
        return LoosePieces(crumb, (), 0)
    # What hangs free itself holds nothing. Each search tree is built once, however many pieces there are.
    holds = [MeshDistance(*mesh) for mesh in ((vertices, faces[~np.isin(piece, candidates)]), *others)]
    touch = _TOUCH * float(np.ptp(vertices, axis=0).max())
    for part in candidates:
        mine = faces[piece == part]
        points = vertices[np.unique(mine)]
        if any(hold.unsigned(points).min() <= touch or hold.inside(points).any() for hold in holds):
            continue
        if volume[part] > CRUMB_SHARE * removed:
            large += 1
            continue
        solid = Solid(*_used(vertices, mine))
        hollow = [part, *(p for p in np.flatnonzero(volume < 0) if _is_within(solid, vertices[faces[piece == p]]))]
        crumb |= np.isin(piece, hollow)
        solids.append(solid)
    return LoosePieces(crumb, tuple(solids), large)


def _is_within(solid: Solid, corners: np.ndarray) -> bool:
    return bool(MeshDistance(solid.vertices, solid.faces).inside(corners.reshape(-1, 3)).all())


def _used(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    used, own = np.unique(faces, return_inverse=True)
    return vertices[used], own.reshape(-1, 3)
