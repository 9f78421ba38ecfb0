"""PLY files of triangles, as this package writes them, and read back with care."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.float_steps import is_coarse

_POSITION = {"float": "<f4", "double": "<f8"}
_FACE = np.dtype([("count", "u1"), ("index", "<i4", 3)])
_OWN_HEADER = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\nelement vertex (\d{1,10})\nproperty (float|double) x\nproperty \2 y\n"
    rb"property \2 z\nelement face (\d{1,10})\nproperty list uchar int vertex_indices\nend_header\n"
)


def ply_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A binary little-endian PLY of vertices (V, 3) and triangles (F, 3).

    Positions are float32, or float64 where they lie too far from the origin for that.
    """
    kind = "double" if is_coarse(vertices) else "float"
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty {kind} x\nproperty {kind} y\nproperty {kind} z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=_FACE)
    rows["count"], rows["index"] = 3, faces
    return header.encode("ascii") + np.ascontiguousarray(vertices, _POSITION[kind]).tobytes() + rows.tobytes()


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) int64 of a PLY that `ply_bytes` has made, checked.

    Raises:
        UserError: a file that is not as it was written: cut short, NaN, an index out of range.
    """
    damaged = UserError(f"{path}: is damaged or not from this run; run the geometry stage again (--resume)")
    try:
        data = path.read_bytes()
    except OSError:
        raise damaged from None
    found = _OWN_HEADER.match(data)
    if found is None:
        raise damaged
    start, points, triangles = found.end(), int(found[1]), int(found[3])
    kind = np.dtype(_POSITION[found[2].decode()])
    end = start + 3 * kind.itemsize * points
    if len(data) != end + _FACE.itemsize * triangles:
        raise damaged
    vertices = np.frombuffer(data, kind, 3 * points, start).reshape(-1, 3).astype(np.float64)
    rows = np.frombuffer(data, _FACE, triangles, end)
    faces = rows["index"].astype(np.int64).reshape(-1, 3)
    in_range = not len(faces) or (faces.min() >= 0 and faces.max() < points)
    if not in_range or (rows["count"] != 3).any() or not np.isfinite(vertices).all():
        raise damaged
    return vertices, faces
