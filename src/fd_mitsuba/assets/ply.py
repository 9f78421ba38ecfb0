"""PLY: polygons, colours of 8 and 16 bits and floats, UVs at vertices and at corners, a texture named in a comment."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fd_mitsuba.assets.asset import MOST_FACES, Asset, AssetMaterial, Texture
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.assets.corners import Corners
from fd_mitsuba.assets.images import beside, read_image
from fd_mitsuba.assets.ply_rows import PlyElement, read_ply_rows
from fd_mitsuba.io.srgb import linear_from_srgb

_INDICES = ("vertex_indices", "vertex_index")
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLOUR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_TEXTURE_COMMENT = "texturefile"


def read_ply_asset(path: Path) -> Asset:
    """A PLY as one mesh. Whole-number colours are taken for sRGB, as programs show them, floats for linear.

    Raises:
        BrokenAsset: no faces, an index out of range, a number that is none, too many faces.
    """
    elements, comments = read_ply_rows(path)
    vertex, face = elements.get("vertex", PlyElement()), elements.get("face", PlyElement())
    indices = next((face.lists[name] for name in _INDICES if name in face.lists), None)
    if indices is None or not len(indices[1]):
        raise BrokenAsset("has no faces, only points; make a surface of them, as in MeshLab")
    positions = _columns(vertex, ("x", "y", "z"))
    if positions is None:
        raise BrokenAsset("has no positions x, y, z; save the mesh anew")
    if not np.isfinite(positions).all():
        raise BrokenAsset("has positions that are NaN or infinite; save the mesh anew")
    counts, position = indices[0], indices[1].astype(np.int64)
    if len(counts) > MOST_FACES:
        raise BrokenAsset(f"has more than {MOST_FACES // 1_000_000} million faces; decimate it to a tenth")
    if position.min() < 0 or position.max() >= len(positions):
        raise BrokenAsset("has a face whose vertex is not there; save the mesh anew")
    notes = []
    solid = counts >= 3
    if not solid.all():
        notes.append(f"{int((~solid).sum())} faces of less than three corners are left out")
        position = position[np.repeat(solid, counts)]
    corners = Corners(positions, counts[solid], position)
    _add_uvs(corners, vertex, face, solid, counts)
    normals = _columns(vertex, ("nx", "ny", "nz"))
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        usable = np.isfinite(normals).all(axis=1) & (length[:, 0] > 0)
        corners.normals = np.nan_to_num(normals) / np.maximum(np.nan_to_num(length), 1e-30)
        corners.normal = np.where(usable, np.arange(len(positions)), -1)[position]
    corners.colours = _colours(vertex)
    if corners.colours is None:
        colours = _colours(face)
        corners.face_colours = None if colours is None else colours[solid]
    materials = _materials(path, comments, corners, notes)
    mesh = corners.mesh(path.stem, material=0 if materials else -1)
    if materials and mesh.colours is not None:
        notes.append("its colours are left out, because it has a texture")
    return Asset((mesh,), materials, notes=tuple(notes))


def _add_uvs(corners: Corners, vertex: PlyElement, face: PlyElement, solid: np.ndarray, counts: np.ndarray) -> None:
    """UVs of corners where the faces have them, else those of vertices; v runs upwards in the file."""
    found = face.lists.get("texcoord")
    if found is not None and np.array_equal(found[0], 2 * counts):
        values = found[1].astype(np.float64).reshape(-1, 2)[np.repeat(solid, counts)]
        corners.uvs, corners.uv = np.unique(_from_top(values), axis=0, return_inverse=True)
        corners.uv = corners.uv.reshape(-1)
        return
    for names in _UV_NAMES:
        values = _columns(vertex, names)
        if values is not None:
            corners.uvs, corners.uv = _from_top(values), corners.position
            return


def _from_top(uvs: np.ndarray) -> np.ndarray:
    uvs = np.nan_to_num(uvs, nan=0.0, posinf=0.0, neginf=0.0)
    return np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1)


def _colours(element: PlyElement) -> np.ndarray | None:
    for names in _COLOUR_NAMES:
        if all(name in element.columns for name in names):
            columns = [element.columns[name] for name in names]
            kind = columns[0].dtype
            values = np.stack(columns, axis=1).astype(np.float64)
            if kind.kind == "f":
                return np.clip(np.nan_to_num(values), 0.0, 1.0)
            return linear_from_srgb(values / np.iinfo(kind).max)
    return None


def _columns(element: PlyElement, names: tuple[str, ...]) -> np.ndarray | None:
    if not all(name in element.columns for name in names):
        return None
    return np.stack([element.columns[name].astype(np.float64) for name in names], axis=1)


def _materials(path: Path, comments: list[str], corners: Corners, notes: list[str]) -> tuple[AssetMaterial, ...]:
    named = [comment.split(None, 1)[1] for comment in comments if comment.lower().startswith(f"{_TEXTURE_COMMENT} ")]
    if not named or corners.uv is None:
        return ()
    if len(named) > 1:
        notes.append(f"names {len(named)} textures, of which only the first is used; save it as OBJ or GLB")
    image = beside(path.parent, named[0].strip())
    if not image.is_file():
        notes.append(f"its image {named[0][:60]!r} is not beside it and is left out")
        return ()
    return (AssetMaterial("texture", base_texture=Texture(read_image(image))),)
