"""Meshes with normals, UVs and attributes as PLY files that Mitsuba reads back with the same numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

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
