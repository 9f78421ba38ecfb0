"""Wavefront OBJ with its MTL: polygons, negative and per-corner indices, several materials, colours at vertices."""

from __future__ import annotations

from codecs import BOM_UTF8
from pathlib import Path

import numpy as np

from fd_mitsuba.assets.asset import MOST_FACES, Asset, AssetMaterial
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.corners import Corners
from fd_mitsuba.assets.images import beside
from fd_mitsuba.assets.mtl import read_mtl
from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.io.srgb import linear_from_srgb

_MOST_BYTES = 1 << 32
_REMEDY = "save the mesh anew"


def read_obj(path: Path) -> Asset:
    """An OBJ as one mesh a material.

    Raises:
        BrokenAsset: no faces, an index out of range, a number that is none, too many faces.
    """
    try:
        data = read_regular(path, _MOST_BYTES)
    except NotReadable as error:
        raise BrokenAsset(str(error)) from None
    if data.count(b"\nf ") + data.count(b"\nf\t") > MOST_FACES:
        raise BrokenAsset(f"has more than {MOST_FACES // 1_000_000} million faces; decimate it to a tenth")
    text = _Text(data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" "))
    if not text.counts:
        raise BrokenAsset("has no faces, only points or lines; save a surface")
    notes: list[str] = []
    materials: dict[str, AssetMaterial] = {}
    for name in text.libraries:
        try:
            materials |= read_mtl(beside(path.parent, name), notes)
        except BrokenAsset as error:
            raise BrokenAsset(f"{name}: {error}" if str(error).startswith("material") else str(error)) from None
    return _asset(text, materials, notes)


class _Text:
    """The lines of an OBJ, sorted by what they say."""

    def __init__(self, data: bytes) -> None:
        self.vertices: list[list[bytes]] = []
        self.uvs: list[list[bytes]] = []
        self.normals: list[list[bytes]] = []
        self.corners: list[bytes] = []
        self.counts: list[int] = []
        self.ends: list[tuple[int, int, int]] = []
        """For each face how many positions, UVs and normals came before it, which negative indices count from."""
        self.material: list[int] = []
        self.names: list[str] = []
        self.libraries: list[str] = []
        self.skipped = 0
        current = -1
        rows = {b"v": self.vertices, b"vt": self.uvs, b"vn": self.normals}
        for line in data.removeprefix(BOM_UTF8).splitlines():
            words = line.split()
            if not words:
                continue
            key = words[0]
            if key in rows:
                rows[key].append(words[1:])
            elif key == b"f":
                if len(words) < 4:
                    self.skipped += 1
                    continue
                given = words[1:] if b"#" not in line else line.partition(b"#")[0].split()[1:]
                self.corners += given
                self.counts.append(len(given))
                self.ends.append((len(self.vertices), len(self.uvs), len(self.normals)))
                self.material.append(current)
            elif key == b"usemtl":
                name = line.split(None, 1)[1].strip().decode("utf-8", "replace") if len(words) > 1 else ""
                if name not in self.names:
                    self.names.append(name)
                current = self.names.index(name)
            elif key == b"mtllib":
                self.libraries.append(line.split(None, 1)[1].strip().decode("utf-8", "replace"))


def _asset(text: _Text, materials: dict[str, AssetMaterial], notes: list[str]) -> Asset:
    counts = np.array(text.counts, dtype=np.int64)
    positions, colours = _positions(text.vertices)
    uvs, normals = _table(text.uvs, 2, "UV", 0.0), _table(text.normals, 3, "normal", 0.0)
    index = _indices(text, counts, (len(positions), len(uvs), len(normals)))
    uvs = np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1) if len(uvs) else uvs
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normal = index[:, 2].copy()
    normal[(normal >= 0) & ~(lengths[np.maximum(normal, 0), 0] > 0 if len(normals) else False)] = -1
    normals = normals / np.maximum(lengths, 1e-30)
    corners = Corners(positions, counts, index[:, 0], uvs, index[:, 1], normals, normal, colours)
    owner = np.array(text.material, dtype=np.int64)
    meshes, found = [], []
    for number in np.unique(owner):
        name = text.names[number] if number >= 0 else "mesh"
        material = -1
        if number >= 0 and name in materials:
            material = len(found)
            found.append(materials[name])
        elif number >= 0 and materials:
            notes.append(f"material {name!r} is in none of its material files, and is grey")
        elif number >= 0 and not text.libraries:
            notes.append("names materials, but no file of materials (mtllib), so that the mesh is grey")
        meshes.append(corners.mesh(name, np.nonzero(owner == number)[0], material))
    if text.skipped:
        notes.append(f"{text.skipped} faces of less than three corners are left out")
    return Asset(tuple(meshes), tuple(found), notes=tuple(dict.fromkeys(notes)))


def _positions(rows: list[list[bytes]]) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions, and colours behind them where every vertex has some: x y z r g b, or x y z w r g b."""
    widths = {len(row) for row in rows}
    positions = _table([row[:3] for row in rows], 3, "position")
    if not rows or min(widths) < 6:
        return positions, None
    colours = _table([row[-3:] for row in rows], 3, "colour")
    if colours.max() > 1.0:
        colours = colours / 255.0
    return positions, linear_from_srgb(colours)


def _table(rows: list[list[bytes]], width: int, what: str, otherwise: float | None = None) -> np.ndarray:
    if not rows:
        return np.zeros((0, width))
    try:
        table = np.array([row[:width] for row in rows], dtype=np.bytes_).astype(np.float64)
    except ValueError:
        table = _careful(rows, width, what)
    if not np.isfinite(table).all():
        if otherwise is None:
            count = int((~np.isfinite(table)).any(axis=1).sum())
            raise BrokenAsset(f"{count} of {len(table)} {what}s are NaN or infinite; {_REMEDY}")
        table = np.nan_to_num(table, nan=otherwise, posinf=otherwise, neginf=otherwise)
    return table


def _careful(rows: list[list[bytes]], width: int, what: str) -> np.ndarray:
    """As `_table`, for rows of different lengths: what is missing is 0."""
    table = np.zeros((len(rows), width))
    for number, row in enumerate(rows):
        try:
            values = [float(word) for word in row[:width]]
        except ValueError:
            raise BrokenAsset(f"{what} {number + 1} is not a number; {_REMEDY}") from None
        if what == "position" and len(values) < width:
            raise BrokenAsset(f"{what} {number + 1} has {len(values)} numbers; {_REMEDY}")
        table[number, : len(values)] = values
    return table


def _indices(text: _Text, counts: np.ndarray, sizes: tuple[int, int, int]) -> np.ndarray:
    """(C, 3) indices of position, UV and normal of each corner, from 0; -1 where it names none."""
    try:
        index = np.array([_corner(corner) for corner in text.corners], dtype=np.int64)
    except (ValueError, OverflowError):
        raise BrokenAsset(f"has a face whose indices are no numbers; {_REMEDY}") from None
    ends = np.repeat(np.array(text.ends, dtype=np.int64), counts, axis=0)
    index = np.where(index < 0, index + ends, index - 1)  # 0 is none, and becomes -1
    names = ("position", "UV", "normal")
    for column in range(3):
        least = 0 if column == 0 else -1
        bad = (index[:, column] < least) | (index[:, column] >= sizes[column])
        if bad.any():
            face = int(np.searchsorted(np.cumsum(counts), np.argmax(bad), side="right")) + 1
            raise BrokenAsset(f"face {face} names a {names[column]} of {sizes[column]} that is not there; {_REMEDY}")
    return index


def _corner(word: bytes) -> tuple[int, int, int]:
    pieces = word.split(b"/")
    uv = int(pieces[1]) if len(pieces) > 1 and pieces[1] else 0
    return int(pieces[0]), uv, int(pieces[2]) if len(pieces) > 2 and pieces[2] else 0
