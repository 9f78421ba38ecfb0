"""A solid cut out of one of the base's meshes, whose other triangles and vertex attributes stay as they were.

manifold3d makes the cut. It works on the mesh welded by position, and returns of each triangle which one of the input
it comes from: an input triangle that comes back whole is taken from the input itself, bit for bit, and a triangle that
the cut splits carries the interpolated attributes. Faces of the cut itself come from the solid and have none.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.solid.solid import Solid


@dataclass(frozen=True)
class CutMesh:
    """A mesh after a cut.

    Attributes:
        vertices: (V, 3) float64; the first `len` of the input's are the input's, in its order, used or not.
        faces: (F, 3) int64, untouched faces first, in the input's order.
        attributes: (V, C) float64, zero on the cut's own vertices.
        source: (F,) the input's face that a face is or is a piece of; -1: the cut's own face.
        untouched: (F,) bool, a face of the input as it was.
    """

    vertices: np.ndarray
    faces: np.ndarray
    attributes: np.ndarray
    source: np.ndarray
    untouched: np.ndarray


def cut_mesh(name: str, vertices: np.ndarray, faces: np.ndarray, attributes: np.ndarray, solid: Solid) -> CutMesh:
    """The mesh (vertices (V, 3), faces (F, 3)) without `solid`, both in one frame.

    Args:
        name: of the mesh, for messages.
        attributes: (V, C) per vertex, such as UVs and colours; C may be 0.

    Raises:
        UserError: the mesh is not closed (a cut needs an inside), or the solid is not one.
    """
    vertices, attributes = np.asarray(vertices, np.float64), np.asarray(attributes, np.float64)
    attributes = attributes.reshape(len(vertices), -1)
    if not solid.manifold:
        raise UserError(f"base {name!r}: what was learned is no closed solid, so it cannot be cut out; run more steps")
    whole, whole_id = _manifold(np.hstack([vertices, attributes]), faces)
    if whole.status() != manifold3d.Error.NoError or not whole.volume() > 0:
        raise UserError(f"base {name!r}: is not closed, so nothing can be cut out of it; close its holes")
    tool, _ = _manifold(solid.vertices, solid.faces)
    made = (whole - tool).to_mesh64()
    rows = np.asarray(made.vert_properties, dtype=np.float64)
    triangles = np.asarray(made.tri_verts, dtype=np.int64)
    source = np.full(len(triangles), -1, dtype=np.int64)
    bounds = np.asarray(made.run_index, dtype=np.int64) // 3
    for start, end, original in zip(bounds[:-1], bounds[1:], made.run_original_id, strict=True):
        if original == whole_id:
            source[start:end] = np.asarray(made.face_id, dtype=np.int64)[start:end]
    return _joined(vertices, np.asarray(faces, np.int64), attributes, rows, triangles, source)


def _joined(
    vertices: np.ndarray,
    faces: np.ndarray,
    attributes: np.ndarray,
    rows: np.ndarray,
    triangles: np.ndarray,
    source: np.ndarray,
) -> CutMesh:
    pieces = np.bincount(source[source >= 0], minlength=len(faces))
    whole = np.zeros(len(triangles), dtype=bool)
    single = np.flatnonzero((source >= 0) & (pieces[source] == 1))
    corners = np.sort(rows[triangles[single], :3], axis=1)
    whole[single] = np.all(corners == np.sort(vertices[faces[source[single]]], axis=1), axis=(1, 2))
    kept = np.sort(source[whole])
    used, local = np.unique(triangles[~whole], return_inverse=True)
    own = np.zeros((len(used), attributes.shape[1]))
    width = rows.shape[1] - 3
    own[:, :width] = rows[used, 3:]
    return CutMesh(
        vertices=np.concatenate([vertices, rows[used, :3]]),
        faces=np.concatenate([faces[kept], local.reshape(-1, 3) + len(vertices)]),
        attributes=np.concatenate([attributes, own]),
        source=np.concatenate([kept, source[~whole]]),
        untouched=np.arange(len(triangles)) < len(kept),
    )


def _manifold(rows: np.ndarray, faces: np.ndarray) -> tuple[manifold3d.Manifold, int]:
    """The solid of vertices with attributes (V, 3 + C), welded by equal positions, and the number it is known by."""
    rows = np.array(rows, dtype=np.float64, order="C")
    number = manifold3d.Manifold.reserve_ids(1)
    _, first, group = np.unique(rows[:, :3] + 0.0, axis=0, return_index=True, return_inverse=True)
    target = first[group.reshape(-1)]
    doubled = np.flatnonzero(target != np.arange(len(rows)))
    mesh = manifold3d.Mesh64(
        rows,
        np.array(faces, dtype=np.uint64, order="C"),
        merge_from_vert=doubled.astype(np.uint64),
        merge_to_vert=target[doubled].astype(np.uint64),
        run_index=np.array([0, 3 * len(faces)], dtype=np.uint64),
        run_original_id=np.array([number], dtype=np.uint32),
        face_id=np.arange(len(faces), dtype=np.uint64),
    )
    return manifold3d.Manifold(mesh), number
