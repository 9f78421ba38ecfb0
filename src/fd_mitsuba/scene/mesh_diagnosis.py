"""Why Mitsuba does not read a mesh file, or reads it wrongly: the cause and what to do, in the words of a modeller."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fd_mitsuba.scene.ply_header import PlyHeader, read_ply_header

_POLYGON = re.compile(rb"^f(?:[ \t]+[^\s]+){4}", re.MULTILINE)
_TRIANGULATE = "triangulate the mesh as you export it"
_INDICES = ("vertex_index", "vertex_indices")
_SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_SIZES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}


def mesh_fault(path: Path) -> str | None:
    """What Mitsuba cannot read in a PLY or OBJ file, and the remedy; None if nothing of that kind is found."""
    try:
        if path.suffix.lower() == ".ply":
            return _ply_fault(path)
        if path.suffix.lower() == ".obj":
            return _obj_fault(path)
    except (OSError, ValueError, IndexError, KeyError, OverflowError):
        return None
    return None


def obj_has_colours(path: Path) -> bool:
    """Whether the first vertex of an OBJ file has a colour behind its position."""
    if path.suffix.lower() != ".obj":
        return False
    return next((len(words) in (7, 8) for word, words in _obj_lines(path) if word == b"v"), False)


def obj_concave_face(path: Path) -> int | None:
    """The first face, counted from 1, of more than three corners that Mitsuba cuts into triangles outside of it.

    Mitsuba cuts from the first corner, which is right for convex faces only. None where there is no such face.
    """
    if not _POLYGON.search(path.read_bytes()):
        return None  # in seconds less, for a mesh of millions of triangles
    try:
        return _concave_face(path)
    except (ValueError, IndexError):
        return None  # Mitsuba has read the file, and knows better what it says


def _concave_face(path: Path) -> int | None:
    positions: list[list[float]] = []
    number = 0
    for word, words in _obj_lines(path):
        if word == b"v":
            positions.append([float(value) for value in words[1:4]])
        elif word == b"f":
            number += 1
            if len(words) > 4:
                index = [int(corner.split(b"/")[0]) for corner in words[1:]]
                corners = np.array([positions[i - 1 if i > 0 else i] for i in index])
                if _fan_folds(corners):
                    return number
    return None


def _fan_folds(corners: np.ndarray) -> bool:
    """Whether the triangles from the first corner of a polygon (N, 3) do not all face one way."""
    edges = corners[1:] - corners[0]
    normal = np.cross(edges[:-1], edges[1:])
    whole = normal.sum(axis=0)
    return bool((normal @ whole < -1e-6 * (whole @ whole)).any())


def _obj_lines(path: Path) -> Iterator[tuple[bytes, list[bytes]]]:
    with open(path, "rb") as file:
        for line in file:
            if line.startswith((b"v", b"f")):
                words = line.partition(b"#")[0].split()
                yield words[0], words


def _obj_fault(path: Path) -> str | None:
    vertices = faces = zero_normals = 0
    for word, words in _obj_lines(path):
        if word in (b"v", b"vn"):
            numbers = [float(value) for value in words[1:4]]
            if not np.isfinite(numbers).all():
                kind = "normal" if word == b"vn" else "position"
                return f"a vertex {kind} is NaN or infinite; save the mesh anew"
            vertices += word == b"v"
            zero_normals += word == b"vn" and not any(numbers)
        elif word == b"f":
            faces += 1
            for corner in words[1:]:
                index = int(corner.split(b"/")[0])
                if index < 0:
                    return (
                        "its faces have negative vertex indices, which OBJ allows and Mitsuba does not read; save it "
                        "with positive ones, as Blender and trimesh do"
                    )
                if not 1 <= index <= vertices:
                    return f"face {faces} names vertex {index} of {vertices}; repair the mesh and save it anew"
    if zero_normals:
        return f"{zero_normals} of its normals have no length; recompute the normals, or save it without"
    return None if faces else "the mesh is empty: it has no faces; save one with faces, not points or curves"


def _ply_fault(path: Path) -> str | None:
    header = read_ply_header(path)
    if header is None:
        return "its header is damaged, or it is no PLY; save the mesh anew"
    if not header.counts.get("face"):
        return "the mesh is empty: it has no faces, only points; make a surface of them, as in MeshLab"
    lists = [item.name for item in header.properties["face"] if item.is_list]
    further = [name for name in lists if name not in _INDICES]
    if not set(lists) & set(_INDICES):
        return f"its faces have no {' or '.join(_INDICES)}; save the mesh anew"
    if further:
        what = "UVs of their own at each corner" if "texcoord" in further else f"a list {further[0]!r}"
        return (
            f"its faces have {what} (property list {further[0]}), which Mitsuba does not read; save UVs per vertex, "
            "in MeshLab by Filters > Texture > Convert PerWedge UV into PerVertex UV"
        )
    corners = _ply_corners(path, header)
    wrong = np.nonzero(corners != 3)[0]
    if len(wrong):
        first = f"face {wrong[0]} has {corners[wrong[0]]} corners"
        return f"{len(wrong)} of its {len(corners)} faces are no triangles ({first}); {_TRIANGULATE}"
    return None


def _ply_corners(path: Path, header: PlyHeader) -> np.ndarray:
    """How many corners each face has, as far as the file can be read."""
    data = path.read_bytes()[header.length :]
    names = list(header.counts)
    before = names[: names.index("face")]
    if header.format == "ascii":
        lines = data.splitlines()[sum(header.counts[name] for name in before) :][: header.counts["face"]]
        place = [item.is_list for item in header.properties["face"]].index(True)
        return np.array([int(line.split()[place]) for line in lines if line.split()])
    if any(item.is_list for name in before for item in header.properties[name]):
        return np.zeros(0, dtype=int)
    start = sum(header.counts[name] * sum(_SIZES[item.type] for item in header.properties[name]) for name in before)
    return _binary_corners(data, start, header)


def _binary_corners(data: bytes, start: int, header: PlyHeader) -> np.ndarray:
    order = "big" if header.format.endswith("big_endian") else "little"
    found = []
    for _ in range(header.counts["face"]):
        corners = 0
        for item in header.properties["face"]:
            if item.is_list:
                size = _SIZES[item.count_type]
                if start + size > len(data):
                    return np.array(found, dtype=int)
                corners = int.from_bytes(data[start : start + size], order)
                start += size + corners * _SIZES[item.type]
            else:
                start += _SIZES[item.type]
        found.append(corners)
    return np.array(found, dtype=int)
