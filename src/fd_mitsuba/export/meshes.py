"""The geometry that a run hands over: parts and assembly as PLY in the user's frame, the base copied byte for byte."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.checkpoint import write_atomically


def ply_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A binary little-endian PLY of vertices (V, 3), written as float32, and triangles (F, 3)."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    return header.encode("ascii") + np.ascontiguousarray(vertices, "<f4").tobytes() + rows.tobytes()


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray, scene: EditScene) -> None:
    """Write a canonical mesh as PLY in the user's frame, whole or not at all."""
    write_atomically(path, ply_bytes(scene.frame.to_user(vertices), faces))


def copy_base(scene: EditScene, folder: Path) -> bool:
    """Copy the base's own files into `folder` and return whether every copy has the bytes of its source.

    An analytic shape has no file: its triangles are written as PLY, and do not count as a copy. Files of the same name
    from different folders keep both: the later gets its shape's name in front.
    """
    folder.mkdir(parents=True, exist_ok=True)
    identical, taken = True, {}
    for mesh in scene.base:
        if not mesh.source_files:
            write_atomically(folder / f"{mesh.name}.ply", ply_bytes(mesh.vertices, mesh.faces))
        for source in mesh.source_files:
            source = Path(source).resolve()
            if source in taken.values():
                continue
            target = folder / source.name
            if target.name in taken:
                target = folder / f"{mesh.name}_{source.name}"
            taken[target.name] = source
            try:
                shutil.copyfile(source, target)
            except OSError as error:
                raise UserError(f"{target}: cannot be written ({error.strerror}); free space or choose another -o") from None
            identical &= _digest(source) == _digest(target)
    return identical


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
