"""Positions of a mesh file in 64 bits, in the order in which Mitsuba, which keeps 32 of them, has its vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fd_mitsuba.scene.ply_header import read_ply_header

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}


def double_positions(path: Path, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) float64 as the file has them where it is a PLY or an OBJ, else `vertices`.

    Args:
        path: the file.
        vertices: (V, 3) as Mitsuba has read them, without a `to_world`. What does not round to them is not used.
    """
    found = read_positions(path)
    if found is None or found.shape != vertices.shape:
        return vertices
    near = np.abs(found - vertices) <= 2 * np.spacing(np.abs(vertices).astype(np.float32))
    return found if bool(near.all()) else vertices


def read_positions(path: Path) -> np.ndarray | None:
    """(V, 3) float64 of a PLY or an OBJ, None where they cannot be read."""
    reader = {".ply": _of_ply, ".obj": _of_obj}.get(path.suffix.lower())
    try:
        return None if reader is None else reader(path)
    except (OSError, ValueError, IndexError, KeyError):
        return None


def has_normals(path: Path) -> bool:
    """Whether a PLY or an OBJ stores normals."""
    header = read_ply_header(path)
    if header is not None:
        return any(item.name == "nx" for item in header.properties.get("vertex", ()))
    try:
        with open(path, "rb") as file:
            return any(line.startswith(b"vn ") for line in file)
    except OSError:
        return False


def _of_ply(path: Path) -> np.ndarray | None:
    header = read_ply_header(path)
    if header is None or next(iter(header.counts), "") != "vertex":
        return None
    properties, count = header.properties["vertex"], header.counts["vertex"]
    names = [item.name for item in properties]
    if any(item.is_list for item in properties) or not {"x", "y", "z"} <= set(names):
        return None
    data = path.read_bytes()[header.length :]
    if header.format == "ascii":
        places = [names.index(axis) for axis in "xyz"]
        rows = [line.split() for line in data.splitlines()[:count]]
        return np.array([[float(row[place]) for place in places] for row in rows])
    order = ">" if header.format.endswith("big_endian") else "<"
    table = np.frombuffer(data, [(item.name, order + _TYPES[item.type]) for item in properties], count)
    with np.errstate(invalid="ignore"):  # of damaged bytes, which are compared with what Mitsuba has read
        return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _of_obj(path: Path) -> np.ndarray:
    """Mitsuba makes a vertex of each combination of position, UV and normal, in the order in which faces name them."""
    positions: list[list[float]] = []
    order: dict[bytes, int] = {}
    with open(path, "rb") as file:
        for line in file:
            words = line.split()
            if words[:1] == [b"v"]:
                positions.append([float(value) for value in words[1:4]])
            elif words[:1] == [b"f"]:
                for corner in words[1:]:
                    order.setdefault(corner, int(corner.split(b"/")[0]) - 1)
    return np.array(positions)[list(order.values())]
