"""STL and OFF: triangles or polygons without materials."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import trimesh

from fd_mitsuba.assets.asset import MOST_FACES, Asset, AssetMesh
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.corners import Corners
from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.io.srgb import linear_from_srgb

_MOST_BYTES = 1 << 32
_TOO_MANY = f"has more than {MOST_FACES // 1_000_000} million faces; decimate it to a tenth"
_STL_HEAD, _STL_ROW = 84, 50


def read_stl(path: Path) -> Asset:
    """An STL, text or binary, with equal corners made one vertex.

    Raises:
        BrokenAsset: damaged, empty, too many faces.
    """
    data = _bytes_of(path)
    announced = struct.unpack_from("<I", data, 80)[0] if len(data) >= _STL_HEAD else 0
    binary = len(data) >= _STL_HEAD and len(data) == _STL_HEAD + _STL_ROW * announced
    if not binary and not data.lstrip()[:5].lower() == b"solid":
        raise BrokenAsset(
            f"is cut short or no STL: it announces {announced} faces and has {len(data)} bytes; save anew"
        )
    if (announced if binary else data.count(b"endfacet")) > MOST_FACES:
        raise BrokenAsset(_TOO_MANY)
    try:
        loaded = trimesh.load_mesh(io.BytesIO(data), file_type="stl" if binary else "stl_ascii", process=False)
        corners = np.asarray(loaded.vertices, dtype=np.float64)[np.asarray(loaded.faces)].reshape(-1, 3)
    except Exception as error:  # a reader of bytes that may be anything
        raise BrokenAsset(f"cannot be read ({' '.join(str(error).split())[:80]}); save the mesh anew") from None
    if not len(corners):
        raise BrokenAsset("has no faces; save a surface")
    if not np.isfinite(corners).all():
        raise BrokenAsset("has positions that are NaN or infinite; save the mesh anew")
    vertices, place = np.unique(corners + 0.0, axis=0, return_inverse=True)
    faces = place.reshape(-1, 3)
    proper = (np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)
    return Asset((AssetMesh(path.stem, vertices, faces[proper]),))


def read_off(path: Path) -> Asset:
    """An OFF with polygons, and with colours at vertices (COFF) or of faces; whole numbers up to 255 are sRGB.

    Raises:
        BrokenAsset: damaged, empty, too many faces.
    """
    try:
        lines = _bytes_of(path).decode("ascii", errors="replace").splitlines()
        rows = [words for line in lines if (words := line.partition("#")[0].split())]
        head = rows.pop(0)
        kind = head.pop(0).upper()
        if not kind.endswith("OFF") or "BINARY" in map(str.upper, head) or "4" in kind or kind.startswith("N4"):
            raise BrokenAsset("is no OFF of text in three dimensions; save it as OFF, PLY or OBJ")
        points, polygons = map(int, (head or rows.pop(0))[:2])
        if polygons > MOST_FACES:
            raise BrokenAsset(_TOO_MANY)
        if points < 0 or polygons < 1 or len(rows) < points + polygons:
            raise BrokenAsset(f"announces {points} vertices and {polygons} faces, and has {len(rows)} rows; save anew")
        table = np.array([[float(word) for word in row] for row in rows[:points]])
        positions = table[:, :3]
        counts, position, tints = [], [], []
        for row in rows[points : points + polygons]:
            count = int(row[0])
            counts.append(count)
            position += [int(word) for word in row[1 : count + 1]]
            tints.append(row[count + 1 : count + 4])
    except (ValueError, IndexError):
        raise BrokenAsset("is damaged: a row is cut short or holds what is no number; save the mesh anew") from None
    lengths, places = np.array(counts), np.array(position, dtype=np.int64)
    if positions.shape != (points, 3) or not np.isfinite(positions).all():
        raise BrokenAsset("has positions that are no numbers; save the mesh anew")
    if (lengths < 3).any() or len(places) != lengths.sum() or places.min() < 0 or places.max() >= points:
        raise BrokenAsset("has a face whose vertices are not there; save the mesh anew")
    corners = Corners(positions, lengths, places)
    width = 6 if kind.startswith("N") or "CN" in kind or kind.startswith("STN") else 3
    if "C" in kind and table.shape[1] >= width + 3:
        corners.colours = _off_colours(table[:, width : width + 3])
    elif all(len(tint) == 3 for tint in tints):
        corners.face_colours = _off_colours(np.array(tints, dtype=np.float64))
    return Asset((corners.mesh(path.stem),))


def _off_colours(values: np.ndarray) -> np.ndarray:
    values = np.nan_to_num(values)
    return linear_from_srgb(values / 255.0 if values.max() > 1.0 else values)


def _bytes_of(path: Path) -> bytes:
    try:
        return read_regular(path, _MOST_BYTES)
    except NotReadable as error:
        raise BrokenAsset(str(error)) from None
