"""Whether each exported part is a solid that can be used: read back from its file, whatever the run has said."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import trimesh

from fd_mitsuba.export.part_record import part_file
from fd_mitsuba.io.float_steps import is_coarse


def check_parts(names: Iterable[str], folder: Path, scale: float) -> dict[str, dict]:
    """Name -> figures of `folder/export/part_<name>.ply`.

    `lost`: there is no file, or none that can be read, or nothing in it. `faces`; `closed`: every edge has two faces,
    of one winding; `pieces`: connected components; `volume`: enclosed, canonical units cubed. `valid`: not lost,
    closed, with a volume.

    Args:
        scale: canonical units in one unit of the user's frame.
    """
    return {name: _check(folder / "export" / part_file(name), scale) for name in names}


def _check(path: Path, scale: float) -> dict:
    try:
        mesh = trimesh.load(path, process=False) if path.is_file() else None
    except Exception:  # of a damaged file, whatever its reader says of it
        mesh = None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return {"lost": True, "valid": False, "faces": 0, "closed": False, "pieces": 0, "volume": 0.0}
    if is_coarse(mesh.vertices):  # products of three coordinates would leave no digits for the volume
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.merge_vertices()
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent)
    volume = float(mesh.volume) * scale**3
    pieces = len(trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1))
    return {
        "lost": False,
        "valid": closed and volume > 0,
        "faces": len(mesh.faces),
        "closed": closed,
        "pieces": pieces,
        "volume": volume,
    }
