"""Triangles of a Mitsuba shape, read through Mitsuba itself but before any of them can reach a ray tracer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.backend.startup import FACES, VERTICES
from fd_mitsuba.io.float_steps import is_coarse
from fd_mitsuba.scene.double_positions import double_positions
from fd_mitsuba.scene.tessellate import Arrays, tube, unit_disk, unit_sphere

FILE_SHAPES = {".ply": "ply", ".obj": "obj", ".serialized": "serialized"}
"""Mitsuba's plugin for a mesh file's suffix."""

ANALYTIC = ("sphere", "disk", "cylinder", "rectangle")
"""Shapes without a file, whose triangles are made here."""


class NotAMesh(Exception):
    """The shape has no triangles and no tessellation here."""


class BrokenMesh(Exception):
    """The shape's triangles cannot be used; the text says what is wrong."""


def shape_triangles(mi: Any, plugin: str, properties: dict[str, Any], to_world: np.ndarray) -> Arrays:
    """Vertices (V, 3) float64 after `to_world` and faces (F, 3) int64 of one Mitsuba shape, checked.

    Positions have the 64 bits of a PLY or an OBJ where they lie so far from the origin that Mitsuba's 32 show. Faces
    are turned round where `to_world` mirrors, so that outward stays outward.

    Args:
        mi: mitsuba with its variant set.
        plugin: the shape's type in the scene file.
        properties: its plain properties (no child objects, no `to_world`).
        to_world: (4, 4) finite and not singular.

    Raises:
        NotAMesh: Mitsuba knows the shape, but not as triangles.
        BrokenMesh: no triangles, an index out of range, a coordinate that is not finite.
        RuntimeError: whatever Mitsuba says about a file that it cannot read.
    """
    vertices, faces = _local_triangles(mi, plugin, properties)
    if not len(vertices) or not len(faces):
        raise BrokenMesh("the mesh is empty (no faces)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        bad = int(np.argmax(np.any((faces < 0) | (faces >= len(vertices)), axis=1)))
        raise BrokenMesh(f"face {bad} has a vertex index out of range (the mesh has {len(vertices)} vertices)")
    broken = ~np.all(np.isfinite(vertices), axis=1)
    if broken.any():
        raise BrokenMesh(f"{int(broken.sum())} of {len(vertices)} vertices are NaN or infinite")
    vertices = vertices @ to_world[:3, :3].T + to_world[:3, 3]
    if np.linalg.det(to_world[:3, :3]) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    return vertices, faces


def _local_triangles(mi: Any, plugin: str, properties: dict[str, Any]) -> Arrays:
    if plugin == "sphere":
        centre = np.array(properties.get("center", [0.0, 0.0, 0.0]), dtype=np.float64).reshape(3)
        vertices, faces = unit_sphere()
        return vertices * float(properties.get("radius", 1.0)) + centre, np.array(faces)
    if plugin == "disk":
        return unit_disk()
    if plugin == "rectangle":
        corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        return corners, np.array([[0, 1, 2], [0, 2, 3]])
    if plugin == "cylinder":
        ends = [
            np.array(properties.get(name, default), dtype=np.float64).reshape(3)
            for name, default in (("p0", [0.0, 0.0, 0.0]), ("p1", [0.0, 0.0, 1.0]))
        ]
        return tube(ends[0], ends[1], float(properties.get("radius", 1.0)))
    description = {"type": plugin, **properties}
    if plugin in FILE_SHAPES.values():
        # Vertex normals would be computed by following the indices, and a bad index then ends the process.
        description["face_normals"] = True
    shape = mi.load_dict(description, optimize=False)
    if not isinstance(shape, mi.Mesh):
        raise NotAMesh
    parameters = mi.traverse(shape)
    if VERTICES not in parameters:
        raise NotAMesh
    vertices = np.array(parameters[VERTICES], dtype=np.float64).reshape(-1, 3)
    faces = np.array(parameters[FACES]).astype(np.int64).reshape(-1, 3)
    filename = properties.get("filename")
    if isinstance(filename, str) and np.isfinite(vertices).all() and is_coarse(vertices):
        vertices = double_positions(Path(str(mi.file_resolver().resolve(filename))), vertices)
    return vertices, faces
