"""Isotropic remeshing of a closed surface: triangles as equal as the surface lets them be.

After Botsch and Kobbelt, "A remeshing approach to multiresolution modeling" (2004): split what is longer than 4/3 of
the wanted edge, collapse what is shorter than 4/5, flip towards Delaunay, let vertices slide in the tangent plane, and
put them back on the surface. Each kind of operation is applied at once to a set of edges that do not touch each
other's faces, chosen by ranks from a fixed seed: the same input gives the same mesh.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fd_mitsuba.export.final_surface.mesh_rings import (
    Edges,
    cross_of_faces,
    edges_of,
    faces_around,
    neighbours,
    summed,
)
from fd_mitsuba.export.final_surface.unfolding import inverted, unfolded

Project = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points (N, 3) -> the nearby points of the surface and the unit outward normals there, (N, 3) each."""

_LONG, _SHORT = 4 / 3, 4 / 5
_FAR_SHORTER = 0.35
_TIDYINGS = 10
_FEW = 0.002
"""Share of the vertices: where fewer go, the next round may as well begin."""
_TURNED = 0.35
"""A collapse or flip may turn a face's normal by at most the angle with this cosine."""
_THIN = 0.05
"""Height over length below which a triangle is a sliver."""
_SHARP = 0.8
"""Edges whose faces' normals have a smaller cosine are left to their crease: a flip would cut it off."""


def remesh(
    vertices: np.ndarray, faces: np.ndarray, edge: float, project: Project, rounds: int = 6
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) of the same surface with edges of about the length `edge`.

    Args:
        vertices: (V, 3). faces: (F, 3) closed and manifold; stays so, with the same pieces and holes.
        project: puts points back on the surface.
    """
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    rng = np.random.default_rng(0)
    for number in range(rounds):
        edges = edges_of(faces, len(vertices))
        long = _lengths(vertices, edges.ends) > _LONG * edge
        if long.any():
            vertices, faces = halved(vertices, faces, edges, long)
        for _ in range(16 if number == 0 else 6):
            count = len(vertices)
            vertices, faces = _collapse(vertices, faces, edge, rng)
            if count - len(vertices) < _FEW * count:
                break
        for _ in range(3):
            faces, changed = _flip(vertices, faces, rng)
            if not changed:
                break
        moved, normals = project(_slid(vertices, faces))
        vertices = unfolded(vertices, moved, faces, free=inverted(vertices, faces, normals))
    for _ in range(2):
        faces, _ = _flip(vertices, faces, rng)
    return vertices, faces


def tidied(vertices: np.ndarray, faces: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """The same surface without edges far shorter than `edge`, nor triangles as flat as their longest side."""
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    rng = np.random.default_rng(0)
    for _ in range(_TIDYINGS):
        count = len(vertices)
        vertices, faces = _collapse(vertices, faces, edge, rng, _FAR_SHORTER)
        faces, flipped = _flip(vertices, faces, rng)
        if len(vertices) == count and not flipped:
            break
    return vertices, faces


def halved(vertices: np.ndarray, faces: np.ndarray, edges: Edges, long: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The marked edges (E,) halved, the new vertices last; faces cut into two, three or four."""
    middle = np.full(len(long), -1)
    middle[long] = len(vertices) + np.arange(long.sum())
    vertices = np.concatenate([vertices, vertices[edges.ends[long]].mean(axis=1)])
    cut = middle[edges.face_edges]
    count = (cut >= 0).sum(axis=1)
    made = [faces[count == 0]]
    # Each case turned so that it starts at one place: one cut edge first, or the edge that is not cut last.
    for number in (1, 2, 3):
        chosen = count == number
        corner, edge = faces[chosen], cut[chosen]
        first = np.argmax(edge >= 0, axis=1) if number == 1 else (np.argmin(edge, axis=1) + 1) % 3 * (number == 2)
        turn = (first[:, None] + np.arange(3)) % 3
        (a, b, c), (ab, bc, ca) = np.take_along_axis(corner, turn, 1).T, np.take_along_axis(edge, turn, 1).T
        if number == 1:
            made += [_rows(a, ab, c), _rows(ab, b, c)]
        elif number == 2:
            # Of the quadrangle a ab bc c the shorter diagonal.
            other = _lengths(vertices, np.stack([ab, c], 1)) < _lengths(vertices, np.stack([a, bc], 1))
            made += [_rows(ab, b, bc)]
            made += [np.where(other[:, None], _rows(a, ab, c), _rows(a, ab, bc))]
            made += [np.where(other[:, None], _rows(ab, bc, c), _rows(a, bc, c))]
        else:
            made += [_rows(a, ab, ca), _rows(ab, b, bc), _rows(ca, bc, c), _rows(ab, bc, ca)]
    return vertices, np.concatenate(made)


def _collapse(
    vertices: np.ndarray, faces: np.ndarray, edge: float, rng: np.random.Generator, share: float = _SHORT
) -> tuple[np.ndarray, np.ndarray]:
    """Some of the short edges shrunk to their middles, where that leaves a closed surface of the same kind."""
    count = len(vertices)
    edges = edges_of(faces, count)
    short = np.flatnonzero(_lengths(vertices, edges.ends) < share * edge)
    if not len(short):
        return vertices, faces
    ends, opposite = edges.ends[short], edges.opposite[short]
    rank = rng.permutation(len(short))
    of_face = _least(_lowest(ends, rank, count)[faces])
    chosen = _equal(_lowest(faces, of_face, count)[ends], rank)
    # An opposite corner loses an edge; two at once could leave it with two.
    chosen &= _equal(_lowest(opposite, rank, count)[opposite], rank)
    ends, opposite = ends[chosen], opposite[chosen]
    # Exactly the two opposite corners are neighbours of both ends, and keep three edges each.
    owner, near = neighbours(edges, count).of(ends[:, 0])
    keys = edges.ends[:, 0] * count + edges.ends[:, 1]
    other = ends[owner, 1]
    common = _found(keys, np.minimum(near, other) * count + np.maximum(near, other))
    good = np.bincount(owner[common], minlength=len(ends)) == 2
    good &= np.bincount(faces.reshape(-1), minlength=count)[opposite].min(axis=1) > 3
    good &= _may_move(vertices, faces, ends, edge)
    ends = ends[good]
    if not len(ends):
        return vertices, faces
    middle = vertices[ends].mean(axis=1)
    keep, gone = ends.T
    vertices = vertices.copy()
    vertices[keep] = middle
    target = np.arange(count)
    target[gone] = keep
    faces = target[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used = np.ones(count, dtype=bool)
    used[gone] = False
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _may_move(vertices: np.ndarray, faces: np.ndarray, ends: np.ndarray, edge: float) -> np.ndarray:
    """Which edges (N,) can shrink to their middles without turning a face over or making an edge too long."""
    around, cross = faces_around(faces, len(vertices)), cross_of_faces(vertices, faces)
    slivers = _slivers(vertices, faces, cross)
    facing = summed(faces, cross, len(vertices))[ends].sum(axis=1)
    middle = vertices[ends].mean(axis=1)
    good = np.ones(len(ends), dtype=bool)
    for side in (0, 1):
        owner, face = around.of(ends[:, side])
        stays = (faces[face] != ends[owner, 1 - side][:, None]).sum(axis=1) == 3
        owner, face = owner[stays], face[stays]
        corners = faces[face]
        moved = np.where((corners == ends[owner, side][:, None])[..., None], middle[owner][:, None], vertices[corners])
        # What a sliver's own normal says is chance: there the one of the ends counts.
        before = np.where(slivers[face][:, None], facing[owner], cross[face])
        after = np.cross(moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0])
        scale = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        bad = np.einsum("ij,ij->i", before, after) <= _TURNED * scale
        bad |= np.linalg.norm(moved - np.roll(moved, 1, axis=1), axis=2).max(axis=1) > _LONG * edge
        good[owner[bad]] = False
    return good


def _flip(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, bool]:
    """Some of the edges turned whose opposite angles are more than 180 degrees together."""
    count = len(vertices)
    edges = edges_of(faces, count)
    wanted = _opposite_angles(vertices, edges) > np.pi + 1e-6
    cross = cross_of_faces(vertices, faces)
    normal = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)
    flat = np.einsum("ij,ij->i", *normal[edges.faces].swapaxes(0, 1)) > _SHARP
    wanted &= flat | _slivers(vertices, faces, cross)[edges.faces].any(axis=1)
    valence = np.bincount(faces.reshape(-1), minlength=count)
    wanted &= (valence[edges.ends] > 3).all(axis=1)
    index = np.flatnonzero(wanted)
    new = np.sort(edges.opposite[index], axis=1)
    new_key = new[:, 0] * count + new[:, 1]
    index = index[~_found(edges.ends[:, 0] * count + edges.ends[:, 1], new_key)]
    if not len(index):
        return faces, False
    first, second = edges.faces[index].T
    c, d = edges.opposite[index].T
    # The first face runs a b c with the edge from a to b.
    at = np.argmax(faces[first] == c[:, None], axis=1)
    a = np.take_along_axis(faces[first], ((at + 1) % 3)[:, None], 1)[:, 0]
    b = np.take_along_axis(faces[first], ((at + 2) % 3)[:, None], 1)[:, 0]
    made = np.stack([_rows(a, d, c), _rows(d, b, c)])
    old = cross[first] + cross[second]
    crosses = [cross_of_faces(vertices, rows) for rows in made]
    scale = np.linalg.norm(old, axis=1)
    fits = np.all([np.einsum("ij,ij->i", old, x) > 0.7 * scale * np.linalg.norm(x, axis=1) for x in crosses], axis=0)
    first, second, made = first[fits], second[fits], made[:, fits]
    rank = rng.permutation(len(first))
    # Of the same corners one flip only: two nearby could make the same edge, or take a corner's last but three.
    corners = np.stack([a, b, c, d], axis=1)[fits]
    chosen = _equal(_lowest(corners, rank, count)[corners], rank)
    faces = faces.copy()
    faces[first[chosen]], faces[second[chosen]] = made[0][chosen], made[1][chosen]
    return faces, bool(chosen.any())


def _slid(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices moved in their tangent planes to the area-weighted middle of the faces around them."""
    cross = cross_of_faces(vertices, faces)
    area = np.linalg.norm(cross, axis=1)
    weight = summed(faces, area[:, None], len(vertices))
    total = summed(faces, vertices[faces].mean(axis=1) * area[:, None], len(vertices))
    move = np.where(weight > 0, total / np.maximum(weight, 1e-300) - vertices, 0.0)
    normal = summed(faces, cross, len(vertices))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return vertices + move - normal * np.einsum("ij,ij->i", move, normal)[:, None]


def _slivers(vertices: np.ndarray, faces: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Which faces (F,) are so thin that their normals mean nothing."""
    corners = vertices[faces]
    longest = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    return np.linalg.norm(cross, axis=1) < _THIN * longest


def _opposite_angles(vertices: np.ndarray, edges: Edges) -> np.ndarray:
    """The two angles opposite to each edge together, (E,)."""
    a, b = vertices[edges.ends[:, 0]], vertices[edges.ends[:, 1]]
    total = np.zeros(len(a))
    for side in (0, 1):
        tip = vertices[edges.opposite[:, side]]
        across = np.linalg.norm(np.cross(a - tip, b - tip), axis=1)
        total += np.arctan2(across, np.einsum("ij,ij->i", a - tip, b - tip))
    return total


def _lowest(rows: np.ndarray, rank: np.ndarray, count: int) -> np.ndarray:
    """The lowest rank (N,) of the rows (N, K) that hold each of `count` vertices; the largest number without one."""
    lowest = np.full(count, np.iinfo(np.int64).max)
    for column in rows.T:
        np.minimum.at(lowest, column, rank)
    return lowest


def _least(rows: np.ndarray) -> np.ndarray:
    """The least of each row (N, 3): NumPy takes ten times as long for it."""
    return np.minimum(np.minimum(rows[:, 0], rows[:, 1]), rows[:, 2])


def _equal(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Whether all of a row (N, K) equal its value (N,)."""
    found = rows[:, 0] == values
    for column in rows.T[1:]:
        found &= column == values
    return found


def _lengths(vertices: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)


def _found(ascending: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Which of `keys` (N,) are among `ascending` (M,)."""
    place = np.minimum(np.searchsorted(ascending, keys), len(ascending) - 1)
    return ascending[place] == keys


def _rows(*columns: np.ndarray) -> np.ndarray:
    return np.stack(columns, axis=1)
