"""Numbers of a mesh file that Mitsuba takes for something else, put right in the mesh that it has loaded.

| in the file | Mitsuba 3.9 | here |
|---|---|---|
| 8-bit colours of a PLY | 0 to 255 | byte / 255, linear, which is what they mean in every other reader |
| colours with alpha | black | the three colours, alpha left out |
| UVs that are NaN or infinite | as they are | 0, and a warning |
| normals that are NaN, infinite or zero | as they are, a black fleck | those of the faces around, and a warning |
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fd_mitsuba.backend.startup import FACES, NORMALS, UVS, VERTICES
from fd_mitsuba.scene.ply_header import read_ply_header
from fd_mitsuba.scene.vertex_normals import vertex_normals, vertices_with_area

if TYPE_CHECKING:
    from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

_BYTE_SCALE = 1.5 / 255
"""A texture that multiplies an attribute by less than this expects bytes: whoever wrote it knew how Mitsuba reads."""
_CHANNEL = re.compile(r"(?:(.*)_)?(?:r|g|b|a|red|green|blue|alpha)", re.IGNORECASE)
_BYTES = ("uchar", "uint8")


@dataclass(frozen=True)
class MeshNumbers:
    """What was put right in a loaded mesh.

    Attributes:
        warnings: what is broken in the file or left out, a sentence each.
        differs: whether plain Mitsuba would show the file otherwise.
        answered: starts of warnings of Mitsuba that are of no matter any more.
    """

    warnings: tuple[str, ...] = ()
    differs: bool = False
    answered: tuple[str, ...] = ()


def correct_mesh(file: SceneFile, element: SceneElement, mesh: Any) -> MeshNumbers:
    """Put right what Mitsuba misread of a shape's mesh, in place.

    Raises:
        UserError: an attribute that a texture reads and that cannot be a colour or a number, or is not finite.
    """
    mi = file.mi
    name = element.properties.get("filename")
    if not isinstance(mesh, mi.Mesh) or not isinstance(name, str):
        return MeshNumbers()
    parameters = mi.traverse(mesh)
    if VERTICES not in parameters:
        return MeshNumbers()
    warnings = [*_correct_uvs(parameters, name), *_correct_normals(parameters, name)]
    path = file.resolve(name)
    bytes_of = tuple(byte_attributes(path))
    differs, lost = _correct_attributes(file, element, mesh, path, bytes_of)
    warnings += lost
    answered = tuple(f'"{path.name}": Mesh attribute "{attribute}" has integer fields' for attribute in bytes_of)
    return MeshNumbers(tuple(str(element.error(line)) for line in warnings), differs or bool(warnings), answered)


def attribute_scales(file: SceneFile, element: SceneElement) -> dict[str, list[float]]:
    """Attribute of a shape's mesh -> the scales of the textures in its BSDF and emitter that read it."""
    found: dict[str, list[float]] = {}
    for texture in _textures_below(file, element):
        if texture.plugin == "mesh_attribute":
            scale = texture.properties.get("scale", 1.0)
            found.setdefault(str(texture.properties.get("name", "")), []).append(float(scale))
    return found


def _textures_below(file: SceneFile, element: SceneElement) -> Iterator[SceneElement]:
    for position in element.children.values():
        child = file.elements[position]
        if child.kind == "texture":
            yield child
        if child.kind in ("bsdf", "texture", "emitter"):
            yield from _textures_below(file, child)


def _correct_uvs(parameters: Any, name: str) -> list[str]:
    if UVS not in parameters:
        return []
    uvs = np.array(parameters[UVS], dtype=np.float32).reshape(-1, 2)
    broken = int((~np.isfinite(uvs)).any(axis=1).sum())
    if not broken:
        return []
    parameters[UVS] = np.nan_to_num(uvs, nan=0.0, posinf=0.0, neginf=0.0).ravel()
    parameters.update()
    return [f"{name}: {broken} of {len(uvs)} UVs are NaN or infinite, and 0 is used instead; unwrap the mesh anew"]


def _correct_normals(parameters: Any, name: str) -> list[str]:
    if NORMALS not in parameters:
        return []
    normals = np.array(parameters[NORMALS], dtype=np.float64).reshape(-1, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        broken = ~(np.linalg.norm(normals, axis=1) > 0.5)  # Mitsuba has made them unit; NaN is broken too
    if not broken.any():
        return []
    vertices = np.array(parameters[VERTICES], dtype=np.float64).reshape(-1, 3)
    faces = np.array(parameters[FACES]).astype(np.int64).reshape(-1, 3)
    around = vertex_normals(vertices, faces, welded=True)
    # They may all point inwards, as `flip_normals` wants them: the others tell.
    if np.einsum("ij,ij->", normals[~broken], around[~broken]) < 0:
        around = -around
    parameters[NORMALS] = np.where(broken[:, None], around, normals).astype(np.float32).ravel()
    parameters.update()
    seen = int(broken[vertices_with_area(vertices, faces)].sum())  # elsewhere nothing is ever shaded
    problem = f"{name}: {seen} of {len(normals)} normals are NaN, infinite or zero, and those of the faces are used"
    return [f"{problem} instead; recompute the normals"] if seen else []


def _correct_attributes(
    file: SceneFile, element: SceneElement, mesh: Any, path: Path, bytes_of: Collection[str]
) -> tuple[bool, list[str]]:
    """Whether one that the scene reads was misread, and what of it is left out."""
    mi, scales, corrected, lost = file.mi, attribute_scales(file, element), False, []
    parameters = mi.traverse(mesh)
    for name in [key for key in parameters.keys() if key.startswith(("vertex_", "face_")) and "." not in key]:
        if name in (VERTICES, NORMALS, UVS) or not mesh.has_attribute(name)[0]:
            continue
        values = np.array(parameters[name], dtype=np.float32)
        rows = values.reshape(mesh.vertex_count() if name.startswith("vertex_") else mesh.face_count(), -1)
        read = scales.get(name, [])
        if not read:
            continue
        if not np.isfinite(rows).all():
            count = int((~np.isfinite(rows)).any(axis=1).sum())
            problem = f"{name} holds NaN or infinity in {count} of {len(rows)} places"
            raise element.error(f"{path.name}: {problem}; save it anew")
        if name in bytes_of:
            raw = [scale < _BYTE_SCALE for scale in read]
            if any(raw) and not all(raw):
                raise element.error(
                    f"{path.name}: {name} holds bytes, and its textures read it with the scales "
                    f"{', '.join(f'{scale:g}' for scale in sorted(set(read)))}; give all of them the scale 1"
                )
            if not any(raw):
                rows, corrected = rows / np.float32(255), True
        if rows.shape[1] == 4:
            if np.ptp(rows[:, 3]) > 0:
                lost.append(f"{path.name}: the alpha of {name} is left out; use a mask for what is to be see-through")
            rows, corrected = rows[:, :3], True
        if rows.shape[1] not in (1, 3):
            raise element.error(f"{path.name}: {name} has {rows.shape[1]} channels; save it as one number or as RGB")
        if not np.array_equal(rows.ravel(), values):
            mesh.remove_attribute(name)
            mesh.add_attribute(name, rows.shape[1], np.ascontiguousarray(rows, dtype=np.float32).ravel())
    return corrected, lost


def byte_attributes(path: Path) -> Iterator[str]:
    """The attributes, as Mitsuba calls them, that a PLY file stores in bytes."""
    header = read_ply_header(path)
    if header is None:
        return
    for kind in ("vertex", "face"):
        for item in header.properties.get(kind, ()):
            group = _CHANNEL.fullmatch(item.name)
            if item.type in _BYTES and not item.is_list and group:
                yield f"{kind}_color_{group[1]}" if group[1] else f"{kind}_color"
