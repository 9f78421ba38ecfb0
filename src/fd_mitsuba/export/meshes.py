"""The geometry that a run hands over: parts and assembly as PLY in the user's frame, the base copied byte for byte."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.ply import ply_bytes
from fd_mitsuba.io.safe_text import safe_file_name
from fd_mitsuba.scene.edit_scene import EditScene


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray, scene: EditScene) -> None:
    """Write a canonical mesh as PLY in the user's frame, whole or not at all."""
    write_atomically(path, ply_bytes(scene.frame.to_user(vertices), faces))


def copy_base(scene: EditScene, folder: Path, textures: Sequence[Path] = ()) -> bool:
    """Copy the base's own files into `folder` and return whether every copy has the bytes of its source.

    An analytic shape has no file: its triangles are written as PLY, and do not count as a copy. A name that is taken
    already, as by a file of another folder, gets its shape's name in front.

    Args:
        textures: pictures that the base's materials read, to copy as well.

    Raises:
        UserError: a source that cannot be read any more, a folder that cannot be written.
    """
    taken, copied = set(), set()

    def copied_whole(prefix: str, source: Path) -> bool:
        source = Path(source).resolve()
        if source in copied:
            return True
        copied.add(source)
        target = folder / _free_name(source.name, prefix, taken)
        try:
            data = source.read_bytes()
        except OSError as error:
            raise UserError(f"{source}: cannot be read any more ({error.strerror}); put the file back") from None
        write_atomically(target, data)
        return target.read_bytes() == data

    results = []
    for mesh in scene.base:
        if not mesh.source_files:
            name = _free_name(f"{mesh.name}.ply", mesh.name, taken)
            write_atomically(folder / name, ply_bytes(mesh.vertices, mesh.faces))
        results += [copied_whole(mesh.name, source) for source in mesh.source_files]
    results += [copied_whole("texture", path) for path in textures]
    return all(results)


def _free_name(wanted: str, prefix: str, taken: set[str]) -> str:
    """`wanted`, or with the prefix and a number where that is taken; without what cannot be in a file name."""
    candidates = itertools.chain([wanted, f"{prefix}_{wanted}"], (f"{prefix}_{i}_{wanted}" for i in itertools.count(2)))
    name = next(safe_file_name(c) for c in candidates if safe_file_name(c) == safe_file_name(c, taken))
    taken.add(name)
    return name
