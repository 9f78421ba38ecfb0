"""3DS: triangles with smoothing groups, one UV a vertex, materials by face; as 3D Studio of MS-DOS has left it.

Source: the published descriptions of the format's chunks. Positions are in world coordinates, z upwards; the key frames
of the second half of a file only move objects in time, and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fd_mitsuba.assets.asset import MOST_FACES, Asset, AssetMaterial, AssetMesh
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.crease_normals import crease_normals
from fd_mitsuba.assets.threeds_chunks import CUT_SHORT, chunks, rows_of, text_of
from fd_mitsuba.assets.threeds_material import read_material
from fd_mitsuba.io.regular_file import NotReadable, read_regular

_MOST_BYTES = 1 << 30
_MAIN, _EDITOR, _KEY_FRAMES = 0x4D4D, 0x3D3D, 0xB000
_MATERIAL, _OBJECT, _TRIANGLES = 0xAFFF, 0x4000, 0x4100
_POINTS, _FACES, _UVS, _MATRIX = 0x4110, 0x4120, 0x4140, 0x4160
_FACE_MATERIAL, _SMOOTHING = 0x4130, 0x4150
_FAR, _SHEET = 1e12, 1e-12
"""Numbers of a matrix beyond or below which it mirrors nothing."""


@dataclass
class _Mesh:
    """What an object's chunks say: vertices (V, 3), faces (F, 3), and for each face its material and groups."""

    name: str
    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))
    uvs: np.ndarray | None = None
    groups: np.ndarray | None = None
    matrix: np.ndarray | None = None
    materials: list[tuple[str, np.ndarray]] = field(default_factory=list)


def read_3ds(path: Path) -> Asset:
    """A 3DS file as one mesh an object and material.

    Raises:
        BrokenAsset: damaged, no faces, too many, an index out of range, an image that cannot be read.
    """
    try:
        data = read_regular(path, _MOST_BYTES)
    except NotReadable as error:
        raise BrokenAsset(str(error)) from None
    if data[:2] != b"MM":
        raise BrokenAsset("is no 3DS; export the model anew, or as GLB")
    notes: list[str] = []
    materials: dict[str, AssetMaterial] = {}
    objects: list[_Mesh] = []
    total = 0
    for kind, main in chunks(memoryview(data)):
        for inner, part in chunks(main) if kind == _MAIN else ():
            if inner == _KEY_FRAMES:
                notes.append("has key frames, which are left out; it is taken as it stands")
            for entry, content in chunks(part) if inner == _EDITOR else ():
                if entry == _MATERIAL:
                    material = read_material(content, path.parent, notes)
                    materials[material.name] = material
                elif entry == _OBJECT:
                    name, rest = text_of(content)
                    added = [_mesh(name, body) for which, body in chunks(rest) if which == _TRIANGLES]
                    objects += added
                    total += sum(len(mesh.faces) for mesh in added)
                    if total > MOST_FACES:
                        raise BrokenAsset(f"has more than {MOST_FACES // 1_000_000} million faces; decimate it")
    numbers = {name: number for number, name in enumerate(materials)}
    meshes = [mesh for item in objects if len(item.faces) for mesh in _pieces(item, numbers, notes)]
    if not meshes:
        raise BrokenAsset("has no faces; save a surface")
    return Asset(tuple(meshes), tuple(materials.values()), up="+z", notes=tuple(dict.fromkeys(notes)))


def _mesh(name: str, data: memoryview) -> _Mesh:
    found = _Mesh(name)
    for kind, part in chunks(data):
        if kind == _POINTS:
            found.vertices = rows_of(part, "<f4", 3)[0]
        elif kind == _UVS:
            uvs = np.nan_to_num(rows_of(part, "<f4", 2)[0], posinf=0.0, neginf=0.0)
            found.uvs = np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1)
        elif kind == _MATRIX:
            if len(part) < 48:
                raise BrokenAsset(CUT_SHORT)
            with np.errstate(invalid="ignore"):
                found.matrix = np.frombuffer(part[:48], "<f4").reshape(4, 3).astype(np.float64)
        elif kind == _FACES:
            table, rest = rows_of(part, "<u2", 4)  # three corners, and which edges are drawn
            found.faces = table[:, :3]
            for inner, body in chunks(rest):
                if inner == _SMOOTHING:
                    if len(body) < 4 * len(table):
                        raise BrokenAsset(CUT_SHORT)
                    found.groups = np.frombuffer(body[: 4 * len(table)], "<u4")
                elif inner == _FACE_MATERIAL:
                    title, list_ = text_of(body)
                    found.materials.append((title, rows_of(list_, "<u2")[0][:, 0]))
    _check(found)
    return found


def _check(mesh: _Mesh) -> None:
    """BrokenAsset for an index out of range; what does not fit the vertices is left out."""
    if len(mesh.faces) and mesh.faces.max() >= len(mesh.vertices):
        face = int(np.argmax(mesh.faces.max(axis=1) >= len(mesh.vertices)))
        count = len(mesh.vertices)
        raise BrokenAsset(f"object {mesh.name!r}: face {face} names a vertex of {count} that is not there; export anew")
    if not np.isfinite(mesh.vertices).all():
        raise BrokenAsset(f"object {mesh.name!r} has positions that are NaN or infinite; export anew")
    for title, faces in mesh.materials:
        if len(faces) and faces.max() >= len(mesh.faces):
            raise BrokenAsset(f"object {mesh.name!r}: material {title!r} is of a face that is not there; export anew")
    if mesh.uvs is not None and len(mesh.uvs) != len(mesh.vertices):
        mesh.uvs = None
    if mesh.matrix is not None and np.abs(mesh.matrix).max() < _FAR and np.linalg.det(mesh.matrix[:3]) < -_SHEET:
        # A mirrored object is stored as it was before it was mirrored.
        axes, centre = mesh.matrix[:3], mesh.matrix[3]
        own = (mesh.vertices - centre) @ np.linalg.inv(axes)
        mesh.vertices = own * [-1.0, 1.0, 1.0] @ axes + centre


def _pieces(mesh: _Mesh, numbers: dict[str, int], notes: list[str]) -> list[AssetMesh]:
    """One mesh a material, shaded across their borders."""
    owner = np.full(len(mesh.faces), -1)
    for title, faces in mesh.materials:
        if title not in numbers:
            notes.append(f"object {mesh.name!r}: material {title!r} is not in the file, so that it is grey")
        owner[faces] = numbers.get(title, -1)
    vertices, faces, uvs, normals = mesh.vertices, mesh.faces, mesh.uvs, None
    if mesh.groups is not None:
        source, normals, faces = crease_normals(vertices, faces, mesh.groups)
        vertices, uvs = vertices[source], None if uvs is None else uvs[source]
    found = []
    for number in np.unique(owner):
        used, compact = np.unique(faces[owner == number], return_inverse=True)
        found.append(
            AssetMesh(
                mesh.name or "mesh",
                vertices[used],
                compact.reshape(-1, 3),
                int(number),
                None if normals is None else normals[used],
                {} if uvs is None else {0: uvs[used]},
            )
        )
    return found
