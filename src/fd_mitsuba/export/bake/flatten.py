"""A chart laid flat with as little stretch as its shape allows: as rigid as possible, after Liu et al. (2008).

"A local/global approach to mesh parameterization": each triangle keeps its own shape, turned into the plane; places
are sought whose triangles differ least from these, and the turns that fit them best, in turns. It starts from Tutte's
embedding in a disc, which never folds.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import ConvexHull

_ROUNDS = 24
_LEAST_WEIGHT = 0.02


class NotFlat(Exception):
    """A chart that does not lie flat.

    Attributes:
        apart: two faces that would be better in different charts, as they overlap; None: nothing is known.
    """

    def __init__(self, apart: tuple[int, int] | None = None) -> None:
        super().__init__()
        self.apart = apart


def flattened(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Places (V, 2) of a disc's vertices in the plane, in their unit of length.

    Args:
        vertices: (V, 3), all of them used. faces: (F, 3) a disc, counter-clockwise: so they are in the plane.

    Raises:
        NotFlat: the faces are no disc, or they fold or overlap.
    """
    loops = border_loops(faces)
    if len(loops) != 1:
        raise NotFlat(_beside_a_hole(faces, loops))
    border = loops[0]
    shapes = _in_their_planes(vertices, faces)
    start = _tutte(vertices, faces, border)
    flat = _as_rigid_as_possible(shapes, faces, start)
    corners = flat[faces]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    if not (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0).all():
        raise NotFlat
    crossing = _crossing(flat[border])
    if crossing is not None:
        first, second = (_face_of(faces, border[side], border[(side + 1) % len(border)]) for side in crossing)
        raise NotFlat((first, second))
    return _upright(flat)


def pinched_apart(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The faces (F, 3) with a vertex of its own for each fan of them around a vertex, and (S,) which vertex each was.

    A chart that touches itself at a vertex is a disc only then.
    """
    corner = np.arange(faces.size).reshape(-1, 3)
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    after = np.roll(corner, -1, axis=1).reshape(-1)
    count = int(faces.max()) + 1
    order = np.argsort(start * count + end)
    keys = (start * count + end)[order]
    wanted = end * count + start
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    found = keys[place] == wanted
    twin = order[place[found]]
    # Across an inner edge a corner at its start is the twin's at its end.
    one, other = np.concatenate([corner.reshape(-1)[found], after[found]]), np.concatenate([after[twin], twin])
    graph = coo_array((np.ones(len(one)), (one, other)), shape=(faces.size,) * 2)
    fan = connected_components(graph, directed=False)[1]
    _, first = np.unique(fan, return_index=True)
    return fan.reshape(-1, 3).astype(np.int64), faces.reshape(-1)[first]


def border_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The loops of vertices (B,) along the border of a mesh, in the order of its faces; none where it is pinched."""
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    count = int(faces.max()) + 1
    alone = ~np.isin(start * count + end, end * count + start)
    following = dict(zip(start[alone].tolist(), end[alone].tolist(), strict=True))
    if len(following) != alone.sum():
        return []
    loops = []
    while following:
        loop = [next(iter(following))]
        while (after := following.pop(loop[-1])) != loop[0]:
            loop.append(after)
        loops.append(np.array(loop))
    return loops


def _beside_a_hole(faces: np.ndarray, loops: list[np.ndarray]) -> tuple[int, int] | None:
    """Faces at opposite sides of the smallest hole: a cut between them goes through it."""
    if not loops:
        return None
    hole = min(loops, key=len)
    half = len(hole) // 2
    return _face_of(faces, hole[0], hole[1]), _face_of(faces, hole[half], hole[(half + 1) % len(hole)])


def _tutte(vertices: np.ndarray, faces: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Border vertices on a circle at their distances from each other, the others each in the middle of its ring."""
    closed = np.concatenate([border, border[:1]])
    along = np.cumsum(np.linalg.norm(np.diff(vertices[closed], axis=0), axis=1))
    angle = 2 * np.pi * np.concatenate([[0.0], along[:-1]]) / along[-1]
    count = len(vertices)
    flat = np.zeros((count, 2))
    flat[border] = along[-1] / (2 * np.pi) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = np.setdiff1d(np.arange(count), border)
    if not len(inner):
        return flat
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graph = coo_array((np.ones(2 * len(ends)), np.concatenate([ends, ends[:, ::-1]]).T), shape=(count, count)).tocsr()
    graph.data[:] = 1.0
    degree = np.asarray(graph.sum(axis=1)).reshape(-1)
    matrix = (-graph + coo_array((degree, (np.arange(count),) * 2), shape=(count, count))).tocsr()
    flat[inner] = splu(csc_array(matrix[inner][:, inner])).solve(-(matrix[inner][:, border] @ flat[border]))
    return flat


def _in_their_planes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Each triangle in a plane of its own, corners (F, 3, 2), the first at 0 and the second on the x axis."""
    corners = vertices[faces]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.maximum(np.linalg.norm(one, axis=1), 1e-30)
    made = np.zeros((len(faces), 3, 2))
    made[:, 1, 0] = length
    made[:, 2, 0] = np.einsum("ij,ij->i", one, other) / length
    made[:, 2, 1] = np.linalg.norm(np.cross(one, other), axis=1) / length
    return made


def _as_rigid_as_possible(shapes: np.ndarray, faces: np.ndarray, flat: np.ndarray) -> np.ndarray:
    count, rows, columns, weights = len(flat), [], [], []
    for corner in range(3):
        one, other = (corner + 1) % 3, (corner + 2) % 3
        a, b = shapes[:, one] - shapes[:, corner], shapes[:, other] - shapes[:, corner]
        area = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1e-30)
        weights.append(np.maximum(np.einsum("ij,ij->i", a, b) / area, _LEAST_WEIGHT) / 2)
        rows.append(faces[:, one])
        columns.append(faces[:, other])
    row, column, weight = np.concatenate(rows), np.concatenate(columns), np.concatenate(weights)
    both = np.concatenate([row, column]), np.concatenate([column, row])
    graph = coo_array((np.tile(weight, 2), both), (count, count))
    degree = np.asarray(graph.sum(axis=1)).reshape(-1)
    matrix = (coo_array((degree, (np.arange(count),) * 2), (count, count)) - graph).tocsr()
    solver = splu(csc_array(matrix[1:][:, 1:]))  # the first vertex stays at 0
    sides = [shapes[:, (corner + 1) % 3] - shapes[:, (corner + 2) % 3] for corner in range(3)]
    for _ in range(_ROUNDS):
        # The turn of each triangle: of sum w (flat side) (own side)^T the nearest rotation, in the plane two numbers.
        cosine, sine = np.zeros(len(faces)), np.zeros(len(faces))
        for side, w, a, b in zip(sides, weights, rows, columns, strict=True):
            now = flat[a] - flat[b]
            cosine += w * np.einsum("ij,ij->i", now, side)
            sine += w * (now[:, 1] * side[:, 0] - now[:, 0] * side[:, 1])
        length = np.maximum(np.hypot(cosine, sine), 1e-30)
        cosine, sine = cosine / length, sine / length
        wanted = np.zeros((count, 2))
        for side, w, a, b in zip(sides, weights, rows, columns, strict=True):
            x, y = side.T
            turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)
            for axis in (0, 1):
                pull = w * turned[:, axis]
                wanted[:, axis] += np.bincount(a, pull, count) - np.bincount(b, pull, count)
        flat = np.concatenate([np.zeros((1, 2)), solver.solve(wanted[1:])])
    return flat


def _crossing(loop: np.ndarray) -> tuple[int, int] | None:
    """Two sides of a closed polygon (N, 2) that cross, by the numbers of their starts; None: none do."""
    start, end = loop, np.roll(loop, -1, axis=0)
    side = end - start

    def left(of: np.ndarray, along: np.ndarray, points: np.ndarray) -> np.ndarray:
        away = points[None] - of[:, None]
        return along[:, None, 0] * away[..., 1] - along[:, None, 1] * away[..., 0]

    parts = left(start, side, start) * left(start, side, end) < 0
    first, second = np.nonzero(parts & parts.T)
    return (int(first[0]), int(second[0])) if len(first) else None


def _face_of(faces: np.ndarray, start: int, end: int) -> int:
    """The face that has the edge from `start` to `end`."""
    return int(np.flatnonzero(((faces == start) & (np.roll(faces, -1, axis=1) == end)).any(axis=1))[0])


def _upright(flat: np.ndarray) -> np.ndarray:
    """Turned so that the rectangle around it is as small as it can be, with its longer side along x: so charts pack."""
    hull = flat[ConvexHull(flat).vertices]
    side = np.roll(hull, -1, axis=0) - hull
    side /= np.linalg.norm(side, axis=1, keepdims=True)  # a smallest rectangle lies along a side of the hull
    along = np.ptp(hull @ side.T, axis=0)
    across = np.ptp(hull @ (side[:, ::-1] * [-1, 1]).T, axis=0)
    best = int(np.argmin(along * across))
    x, y = side[best] if along[best] >= across[best] else side[best, ::-1] * [-1, 1]
    return (flat - flat.mean(axis=0)) @ np.array([[x, -y], [y, x]])
