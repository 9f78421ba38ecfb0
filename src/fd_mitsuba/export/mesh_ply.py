"""Meshes that Mitsuba has loaded as PLY with the same numbers, which its own `write_ply` does not for attributes."""

from __future__ import annotations

from typing import Any

import numpy as np

from fd_mitsuba.backend.startup import FACES, NORMALS, UVS, VERTICES
from fd_mitsuba.io.attribute_ply import attribute_ply


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
