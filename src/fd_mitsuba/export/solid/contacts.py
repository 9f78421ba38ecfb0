"""Where a part stands on the base, and where an end of it hangs free just before the base.

Seen from the base, a part's surface is a landscape: the height of a point is its distance to the base. A contact is a
valley that reaches the ground. A valley that does not, though its floor is close to it and its walls are high, is an
end that was to be attached, such as the upper end of a handle that only the lower one holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.export.solid.part_pieces import BRIDGE_REACH
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.scene.mesh_distance import MeshDistance

_CLOSE = 1.5 * BRIDGE_REACH
"""An end is taken for a free one when it is closer to the base, canonical units; what ends farther away is meant to."""
_STEEP = 3.0
"""And when the way along the surface from it to a contact leads this many times as far from the base as it is."""
_LEAST_WAY = BRIDGE_REACH
"""But at least so much farther away."""


@dataclass(frozen=True)
class Contact:
    """A contact or a free end.

    Attributes:
        position: (3,) where it is nearest to the base, or the middle of what is inside; in the solid's frame.
        gap: what is between it and the base; 0 where it is attached.
    """

    position: np.ndarray
    gap: float


def contacts(solid: Solid, base: MeshDistance) -> list[Contact]:
    """The contacts of a part with the base, then its free ends, the closest first.

    A contact is a connected piece of the part's surface inside the base, so that a part which goes through the base
    has one on either side. Ends of pieces without any contact are not free ends: the piece floats, see `Solid.gap`.

    Args:
        solid: canonical frame.
    """
    height = -base.signed(solid.vertices)
    edges = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    level = height[edges].max(axis=1).clip(min=0)
    floor = height.clip(min=0)
    lowest = np.arange(len(height))  # of the valley that a vertex belongs to: the root of a tree
    free: list[Contact] = []

    def root(vertex: int) -> int:
        while lowest[vertex] != vertex:
            lowest[vertex] = lowest[lowest[vertex]]
            vertex = lowest[vertex]
        return vertex

    for number in np.argsort(level, kind="stable"):
        one, other = root(edges[number, 0]), root(edges[number, 1])
        if one == other:
            continue
        if floor[one] > floor[other]:
            one, other = other, one
        lowest[other] = one
        gap, up = float(floor[other]), float(level[number])
        if 0 < gap < _CLOSE and up > _STEEP * gap and up - gap > _LEAST_WAY and floor[one] == 0:
            free.append(Contact(solid.vertices[other].astype(np.float64), gap))
    return [*_attached(solid, height <= 0), *sorted(free, key=lambda end: end.gap)]


def _attached(solid: Solid, inside: np.ndarray) -> list[Contact]:
    """The connected pieces of the surface that have all their corners in the base."""
    faces = solid.faces[inside[solid.faces].all(axis=1)]
    if not len(faces):
        return []
    piece = Solid(solid.vertices, faces).pieces()
    middles = solid.vertices[faces].mean(axis=1).astype(np.float64)
    return [Contact(middles[piece == number].mean(axis=0), 0.0) for number in range(piece.max() + 1)]
