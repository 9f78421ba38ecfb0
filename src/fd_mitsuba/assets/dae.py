"""COLLADA (.dae): polygons of a scene's nodes, with the colours and images of their effects."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.assets.asset import MOST_FACES, Asset, AssetMaterial, AssetMesh, Texture
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.corners import Corners
from fd_mitsuba.assets.images import found_beside, read_image
from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.io.srgb import linear_from_srgb

_MOST_BYTES = 1 << 29
_UNITS = {0.001: "mm", 0.01: "cm", 1.0: "m"}
_NO_NUMBER = re.compile(rb"<float_array[^>]*>[^<]*?(?i:nan|inf)")
_GREY = (0.8, 0.8, 0.8)


def read_dae(path: Path) -> Asset:
    """A COLLADA file as one mesh a primitive, at the places that its nodes say.

    Raises:
        BrokenAsset: damaged, no faces, too many, an index out of range, or a document type, which no exporter writes.
    """
    try:
        data = read_regular(path, _MOST_BYTES)
    except NotReadable as error:
        raise BrokenAsset(str(error)) from None
    if b"\0" in data[:4096] or data[:2] in (b"\xfe\xff", b"\xff\xfe"):
        raise BrokenAsset("is not UTF-8; save it anew")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise BrokenAsset("declares a document type or entities, which are not read; save it anew")
    if _NO_NUMBER.search(data):  # pycollada would make it 0
        raise BrokenAsset("has positions, UVs or normals that are NaN or infinite; save the model anew")
    import collada  # takes a quarter of a second
    import collada.common

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pycollada uses what NumPy deprecates
        try:
            document = collada.Collada(io.BytesIO(data), ignore=[collada.common.DaeError])
        except Exception as error:  # a reader of bytes that may be anything
            raise BrokenAsset(f"cannot be read ({' '.join(str(error).split())[:80]}); save the model anew") from None
        reader = _Reader(document, path)
    if document.scene is None or not reader.meshes:
        raise BrokenAsset("has no faces in its scene, only points, lines or nothing; save a surface")
    info: Any = document.assetInfo
    scale = float(info.unitmeter or 1.0)
    unit = next((name for metres, name in _UNITS.items() if np.isclose(scale, metres, rtol=1e-6)), None)
    if unit is None:
        reader.notes.append(f"its unit of {scale:g} m is none of mm, cm, m; say what it is by --units")
    up = {"X_UP": "+x", "Y_UP": "+y", "Z_UP": "+z"}.get(str(info.upaxis))
    notes = tuple(dict.fromkeys(reader.notes))
    return Asset(tuple(reader.meshes), tuple(reader.materials), up=up, unit=unit, notes=notes)


class _Reader:
    """The placed primitives of a document; names and numbers are checked as they are met."""

    def __init__(self, document: Any, path: Path) -> None:
        self.path = path
        self.meshes: list[AssetMesh] = []
        self.materials: list[AssetMaterial] = []
        self.notes: list[str] = []
        self._numbers: dict[int, int] = {}
        self._faces = 0
        if document.errors:
            first = " ".join(str(document.errors[0]).split())[:80]
            self.notes.append(f"{len(document.errors)} things in it cannot be read and are left out, such as: {first}")
        if document.animations:
            self.notes.append("is animated; it is taken as it stands at rest")
        if document.controllers:
            self.notes.append("has skinned or morphed meshes, which are left out; apply the pose before saving")
        if document.scene is not None:
            for geometry in document.scene.objects("geometry"):
                for primitive in geometry.primitives():
                    self._read(primitive, str(geometry.original.name or geometry.original.id or "mesh"))

    def _read(self, primitive: Any, name: str) -> None:
        index = primitive.vertex_index
        if primitive.vertex is None or index is None or type(primitive).__name__ == "BoundLineSet":
            return
        position = np.asarray(index, dtype=np.int64).ravel()
        runs = getattr(primitive, "polyindex", None)  # the first corner of each polygon, and the one after its last
        counts = np.full(len(position) // 3, 3) if runs is None else np.diff(np.asarray(runs).reshape(-1, 2))[:, 0]
        if not len(counts):
            return
        self._faces += int((counts - 2).clip(0).sum())
        if self._faces > MOST_FACES:
            raise BrokenAsset(f"has more than {MOST_FACES // 1_000_000} million faces; decimate it to a tenth")
        positions = np.asarray(primitive.vertex, dtype=np.float64)
        if (counts < 3).any() or position.min() < 0 or position.max() >= len(positions):
            raise BrokenAsset(f"mesh {name!r} has a polygon of less than three corners or an index out of range")
        uvs, uv = self._table(primitive.texcoordset, primitive.texcoord_indexset, 2, len(position))
        if uvs is not None:
            uvs = np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1)
        given = [] if primitive.normal is None else [primitive.normal]
        at = [] if primitive.normal_index is None else [primitive.normal_index]
        normals, normal = self._table(given, at, 3, len(position))
        if normals is not None and normal is not None:
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normal = np.where(length[np.maximum(normal, 0), 0] > 0, normal, -1)
            normals = normals / np.maximum(length, 1e-30)
        corners = Corners(positions, counts.astype(np.int64), position, uvs, uv, normals, normal)
        self.meshes.append(corners.mesh(name, material=self._material(primitive.material)))

    def _table(
        self, tables: Any, indices: Any, width: int, corners: int
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The first of several tables and the index of each corner into it; None where there is none that fits."""
        if not len(tables) or not len(indices) or indices[0] is None:
            return None, None
        table, index = (
            np.asarray(tables[0], dtype=np.float64)[:, :width],
            np.asarray(indices[0], dtype=np.int64).ravel(),
        )
        if len(index) != corners or not len(table) or index.min() < 0 or index.max() >= len(table):
            self.notes.append("has UVs or normals with an index out of range, which are left out")
            return None, None
        return table, index

    def _material(self, material: Any) -> int:
        effect = getattr(material, "effect", None)
        if effect is None:
            return -1
        if id(effect) not in self._numbers:
            self._numbers[id(effect)] = len(self.materials)
            self.materials.append(self._surface(str(material.name or material.id or "material"), effect))
        return self._numbers[id(effect)]

    def _surface(self, name: str, effect: Any) -> AssetMaterial:
        """COLLADA knows no roughness; exporters write a shininess by habit, so that what counts is the colour."""
        colour = effect.diffuse
        sides = bool(effect.double_sided)
        if colour is None or isinstance(colour, int | float):
            return AssetMaterial(name, base_color=_GREY, double_sided=sides)
        if isinstance(colour, tuple | list):
            red, green, blue = linear_from_srgb(np.clip(np.asarray(colour[:3], dtype=np.float64), 0, 1)).tolist()
            return AssetMaterial(name, base_color=(red, green, blue), double_sided=sides)
        file = str(colour.sampler.surface.image.path or "").removeprefix("file://")
        place = found_beside(self.path.parent, file) if file else None
        if place is None:
            self.notes.append(f"material {name!r}: its image {file[:60]!r} is not beside the file and is left out")
            return AssetMaterial(name, base_color=_GREY, double_sided=sides)
        try:
            return AssetMaterial(name, base_texture=Texture(read_image(place)), double_sided=sides)
        except BrokenAsset as error:
            raise BrokenAsset(f"material {name!r}: {error}") from None
