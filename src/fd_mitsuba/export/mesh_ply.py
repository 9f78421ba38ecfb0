"""Meshes as PLY that Mitsuba reads back with the same numbers, which its own `write_ply` does not for attributes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fd_mitsuba.backend.startup import FACES, NORMALS, UVS, VERTICES

_CHANNELS = "rgb"


def attribute_ply(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None,
    uv: np.ndarray | None,
    attributes: Mapping[str, np.ndarray],
) -> bytes:
    """A binary PLY, all float32, for which Mitsuba wants no `flip_tex_coords`.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        normals: (V, 3) unit.
        uv: (V, 2), origin top left.
        attributes: name as Mitsuba has it, such as "vertex_color" -> (V, 1 or 3), or (F, 1 or 3) of faces.
    """
    columns, names = [vertices], ["x", "y", "z"]
    for values, own in ((normals, "nx ny nz"), (uv, "s t")):
        if values is not None:
            columns.append(values)
            names += own.split()
    of_faces, face_names = [], []
    for key, values in attributes.items():
        kind, _, group = key.partition("_color")
        labels = [f"{group[1:]}_{channel}" if group else channel for channel in _CHANNELS[: values.shape[1]]]
        if kind == "vertex":
            columns.append(values)
            names += labels
        else:
            of_faces.append(values)
            face_names += labels
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += [*(f"property float {name}" for name in face_names), "end_header", ""]
    fields: list[Any] = [("count", "u1"), ("index", "<i4", 3)]
    if face_names:
        fields.append(("values", "<f4", len(face_names)))
    rows = np.empty(len(faces), dtype=fields)
    rows["count"], rows["index"] = 3, faces
    if face_names:
        rows["values"] = np.concatenate(of_faces, axis=1).reshape(rows["values"].shape)
    data = np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4")
    return "\n".join(header).encode("ascii") + data.tobytes() + rows.tobytes()


def mesh_ply(mi: Any, mesh: Any) -> bytes:
    """A mesh that Mitsuba has loaded, with its normals, UVs and attributes."""
    parameters, count = mi.traverse(mesh), mesh.vertex_count()

    def values(name: str, rows: int) -> np.ndarray:
        return np.array(parameters[name], dtype=np.float32).reshape(rows, -1)

    faces = np.array(parameters[FACES]).astype(np.int64).reshape(-1, 3)
    attributes = {}
    for key in parameters.keys():
        if key.startswith(("vertex_color", "face_color")) and "." not in key:
            found = values(key, count if key.startswith("vertex") else len(faces))
            if found.shape[1] in (1, 3):
                attributes[key] = found
    normals = values(NORMALS, count) if mesh.has_vertex_normals() else None
    uv = values(UVS, count) if mesh.has_vertex_texcoords() else None
    return attribute_ply(values(VERTICES, count), faces, normals, uv, attributes)
