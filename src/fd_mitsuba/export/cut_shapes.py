"""The base's shapes after the parts were cut out of them, with normals, UVs and colours, and what was removed.

Each shape is cut in its own frame, so that a triangle away from the cut keeps every number of its file. A face of the
cut takes the UV, or the colour, that the base has at the nearest point of its surface: one for the whole face, because
three of their own may lie on different charts of an atlas. Where the cut has a learned material, these faces are a mesh
of their own instead, and the shape is left open.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import reduce

import manifold3d
import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.base_shapes import BaseShape, base_shapes
from fd_mitsuba.export.loose_pieces import bodies, loose_pieces
from fd_mitsuba.export.solid.cut_base import CutMesh, cut_mesh
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.io.attribute_ply import attribute_ply
from fd_mitsuba.io.safe_text import safe_name
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.vertex_normals import vertex_normals


@dataclass(frozen=True)
class CutBase:
    """The base after the cut.

    Attributes:
        shapes: what is left of each shape, in the order of the scene; None where nothing is.
        opened: the same without the faces of the cut; None where no other face is left.
        faces: name of a part -> the faces that cutting it out has made on all shapes, welded, user frame, seen from
            where the part was; not closed. Parts that removed nothing are left out.
        is_cut: whether each of them changed.
        removed: name of a part -> what it took away of all shapes, without the crumbs, user frame.
        figures: `removed_volume`, cubic user units, shapes that overlap counted one by one; `volume_change_error`,
            |base - cut - removed| / removed, three volumes that are measured one by one; `crumbs`, how many small
            pieces went because nothing held them any more; `loose_pieces`, how many larger ones are left.
        crumbs: those small pieces, user frame.
    """

    shapes: tuple[BaseShape | None, ...]
    opened: tuple[BaseShape | None, ...]
    faces: dict[str, TriangleMesh]
    is_cut: tuple[bool, ...]
    removed: dict[str, Solid]
    figures: dict[str, float]
    crumbs: tuple[Solid, ...] = ()

    def names(self, opened: bool = False) -> dict[int, str | None]:
        """Number of a shape that was cut -> the name of its file, `open_...` if opened, None where nothing is left."""
        names: dict[int, str | None] = {}
        for i, (shape, is_cut) in enumerate(zip(self.opened if opened else self.shapes, self.is_cut, strict=True)):
            if is_cut:
                taken = [name for name in names.values() if name is not None]
                names[i] = None if shape is None else cut_file(shape.name, "open" if opened else "cut", taken)
        return names

    def without_crumbs(self, union: Solid, margin: float) -> Solid:
        """Another surface of what is left, in the user frame, without its pieces in the places of the crumbs.

        Args:
            margin: how far off the crumbs these pieces may be.
        """
        piece, gone = union.pieces(), np.zeros(len(union.faces), dtype=bool)
        for crumb in self.crumbs:
            distance = MeshDistance(crumb.vertices, crumb.faces)
            for number in np.unique(piece):
                own = union.vertices[np.unique(union.faces[piece == number])].astype(np.float64)
                if np.all((distance.unsigned(own) < margin) | distance.inside(own)):
                    gone |= piece == number
        return Solid(union.vertices, union.faces[~gone])

    def files(self, opened: bool = False) -> dict[str, bytes]:
        """File name -> PLY of every shape that was cut and has something left, in the shape's own frame."""
        names = self.names(opened)
        return {
            name: shape_ply(shape)
            for i, shape in enumerate(self.opened if opened else self.shapes)
            if shape is not None and (name := names.get(i)) is not None
        }


def cut_file(name: str, start: str = "cut", taken: Collection[str] = ()) -> str:
    """The file name of a cut shape's mesh, one that is not taken."""
    return safe_name(f"{start}_{name}", taken, ".ply")


def cut_base(scene: EditScene, file: SceneFile, solids: Mapping[str, Solid]) -> CutBase:
    """The base without the parts' solids, given in the canonical frame.

    Raises:
        UserError: nothing was removed, nothing is left, or a solid or a shape within its reach is not closed.
    """
    tools = {name: solid.moved(np.linalg.inv(scene.frame.matrix())) for name, solid in solids.items()}
    tools = {name: tool for name, tool in tools.items() if len(tool.faces)}
    shapes, opened, is_cut, pieces = [], [], [], {name: [] for name in tools}
    faces: dict[str, list[np.ndarray]] = {name: [] for name in tools}
    before = after = removed = 0.0
    crumbs: list[Solid] = []
    loose = 0
    for shape, mesh in zip(base_shapes(scene, file), scene.base, strict=True):
        left: BaseShape | None = shape
        maker = np.full(len(shape.faces), -1)
        near = {name: tool for name, tool in tools.items() if _boxes_meet(tool.vertices, mesh.vertices)}
        if near:
            body = bodies(shape.vertices, shape.faces)
            whole = manifold3d.Manifold(_plain(mesh.vertices, mesh.faces))
            for name, tool in near.items():
                pieces[name].append(whole ^ _manifold(tool))
            volume = reduce(lambda a, b: a + b, (_manifold(tool) for tool in near.values()))
            own = (whole ^ volume).volume()
            for number, tool in enumerate(near.values()):
                if left is not None:
                    left, source = _cut(left, tool.moved(np.linalg.inv(shape.to_world)))
                    maker = np.where(source < 0, number, maker[source])
                    body = np.where(source < 0, -1, body[source])
            if left is not None:
                beside = [(one.vertices, one.faces) for one in scene.base if one is not mesh]
                vertices, triangles, _ = left.in_user_frame()
                found = loose_pieces(vertices, triangles, body, beside, own)
                if found.solids:
                    left, maker = _some_faces(left, ~found.crumb), maker[~found.crumb]
                    own += sum(solid.volume for solid in found.solids)
                crumbs, loose = [*crumbs, *found.solids], loose + found.large
            removed += own
            before += _volume(shape)
            after += 0.0 if left is None else _volume(left)
            for number, name in enumerate(near):
                if left is not None and (maker == number).any():
                    vertices, triangles, _ = left.in_user_frame()
                    faces[name].append(vertices[triangles[maker == number]].astype(np.float32))
        shapes.append(left)
        opened.append(left if left is None or left is shape else _some_faces(left, maker < 0))
        is_cut.append(left is not shape)
    if not removed > 0:
        raise UserError(f"{scene.path}: nothing was removed from the base; run more steps, or move the region into it")
    if all(shape is None for shape in shapes):
        raise UserError(f"{scene.path}: nothing is left of the base; shrink the region")
    solids_removed = {name: _solid(found) for name, found in pieces.items()}
    figures = {"removed_volume": before - after, "volume_change_error": abs(before - after - removed) / removed}
    figures |= {"crumbs": len(crumbs), "loose_pieces": loose}
    made = {name: _welded(name, np.concatenate(corners)) for name, corners in faces.items() if corners}
    return CutBase(tuple(shapes), tuple(opened), made, tuple(is_cut), solids_removed, figures, tuple(crumbs))


def shape_ply(shape: BaseShape) -> bytes:
    """A binary PLY of a shape in its own frame, every float as it is: v runs as Mitsuba has it, no flip is needed.

    Colours are the attribute that the shape's material reads, before the material scales it.
    """
    attributes, name = {}, shape.material.colours
    if shape.colours is not None:
        values = shape.colours / np.float32(shape.material.colour_scale or 1.0)
        # All corners of a face have one colour where the file gave it to the face.
        attributes[name] = values[shape.faces[:, 0]] if name.startswith("face_") else values
    vertices = shape.vertices + shape.moved if shape.moved.any() else shape.vertices
    return attribute_ply(vertices, shape.faces, shape.normals, shape.uv, attributes)


def _cut(shape: BaseShape, tool: Solid) -> tuple[BaseShape | None, np.ndarray]:
    """The shape without a solid of its own frame; itself if they do not meet, None if nothing is left.

    And of each of its faces, which of the shape's it is or is a piece of; -1 for those that the cut has made.
    """
    carried = [values for values in (shape.normals, shape.uv, shape.colours) if values is not None]
    empty = np.zeros((len(shape.vertices), 0))
    cut = cut_mesh(shape.name, shape.vertices, shape.faces, np.concatenate([empty, *carried], axis=1), tool)
    if cut.untouched.sum() == len(shape.faces) and len(cut.faces) == len(shape.faces):
        return shape, np.arange(len(shape.faces))
    if not len(cut.faces):
        return None, np.zeros(0, dtype=np.int64)
    own = cut.source < 0
    return _assembled(shape, cut), np.concatenate([cut.source[~own], cut.source[own]])


def _assembled(shape: BaseShape, cut: CutMesh) -> BaseShape:
    """The pieces of the base first, then the cut's faces; vertices that nothing uses any more are left out."""
    own = cut.source < 0
    used, kept = np.unique(cut.faces[~own], return_inverse=True)
    corners = cut.vertices[cut.faces[own]]
    rows = [corners.reshape(-1, 3)]
    face, weights = MeshDistance(shape.vertices, shape.faces).nearest(corners.mean(axis=1))
    start, made = 0, {}
    for key in ("normals", "uv", "colours"):
        values = getattr(shape, key)
        if values is None:
            continue
        width = values.shape[1]
        ours = cut.attributes[used, start : start + width].astype(np.float32)
        if key == "normals":
            new = used >= len(shape.vertices)
            ours[new] = _unit(ours[new])
            loose = np.arange(len(rows[0])).reshape(-1, 3)
            added = vertex_normals(rows[0], loose, welded=True).astype(np.float32)
        else:
            added = np.repeat(np.einsum("ij,ijk->ik", weights, values[shape.faces[face]]), 3, axis=0)
        rows.append(added)
        made[key], start = ours, start + width
    merged, place = np.unique(np.concatenate(rows, axis=1).astype(np.float32), axis=0, return_inverse=True)
    vertices = np.concatenate([cut.vertices[used].astype(np.float32), merged[:, :3]])
    start = 3
    for key, ours in made.items():
        made[key] = np.concatenate([ours, merged[:, start : start + ours.shape[1]]])
        start += ours.shape[1]
    faces = np.concatenate([kept.reshape(-1, 3), place.reshape(-1, 3) + len(used)])
    return replace(shape, vertices=vertices, faces=faces, **made)


def _some_faces(shape: BaseShape, chosen: np.ndarray) -> BaseShape | None:
    """The shape with the faces `chosen` (F,) alone and the vertices that these use; None if there are none."""
    if not chosen.any():
        return None
    used, faces = np.unique(shape.faces[chosen], return_inverse=True)
    rows = {key: getattr(shape, key) for key in ("vertices", "normals", "uv", "colours")}
    kept = {key: None if values is None else values[used] for key, values in rows.items()}
    return replace(shape, faces=faces.reshape(-1, 3), **kept)


def _welded(name: str, corners: np.ndarray) -> TriangleMesh:
    """The triangles with corners (F, 3, 3) as a mesh in which equal positions are one vertex; slivers go."""
    vertices, place = np.unique(corners.reshape(-1, 3) + 0.0, axis=0, return_inverse=True)
    faces = place.reshape(-1, 3)
    return TriangleMesh(name, vertices, faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)])


def _unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _boxes_meet(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.all(one.min(axis=0) <= other.max(axis=0)) and np.all(other.min(axis=0) <= one.max(axis=0)))


def _volume(shape: BaseShape) -> float:
    vertices, faces, _ = shape.in_user_frame()
    return TriangleMesh(shape.name, vertices, faces).volume()


def _plain(vertices: np.ndarray, faces: np.ndarray) -> manifold3d.Mesh64:
    """Welded by position."""
    rows, weld = np.unique(np.asarray(vertices, np.float64) + 0.0, axis=0, return_inverse=True)
    welded = weld.reshape(-1)[faces]
    distinct = (np.diff(np.sort(welded, axis=1), axis=1) > 0).all(axis=1)
    return manifold3d.Mesh64(rows, np.array(welded[distinct], dtype=np.uint64, order="C"))


def _manifold(solid: Solid) -> manifold3d.Manifold:
    return manifold3d.Manifold(_plain(solid.vertices, solid.faces))


def _solid(pieces: list[manifold3d.Manifold]) -> Solid:
    if not pieces:
        return Solid(np.zeros((0, 3)), np.zeros((0, 3)))
    mesh = reduce(lambda a, b: a + b, pieces).to_mesh64()
    return Solid(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))
