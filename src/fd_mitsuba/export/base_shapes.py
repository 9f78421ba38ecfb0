"""The base's shapes as Mitsuba reads them, with normals, UVs and colours, for formats that hold all in a file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fd_mitsuba.backend.startup import FACES, NORMALS, UVS, VERTICES
from fd_mitsuba.export.material import PbrMaterial, pbr_material
from fd_mitsuba.export.mesh_ply import mesh_ply
from fd_mitsuba.export.pictures import Picture
from fd_mitsuba.io.float_steps import is_coarse
from fd_mitsuba.scene.double_positions import double_positions
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.mesh_numbers import correct_mesh
from fd_mitsuba.scene.mesh_source import ANALYTIC
from fd_mitsuba.scene.part_stack import StackedPart
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology


@dataclass(frozen=True)
class BaseShape:
    """One shape of the base; floats as in the file, bit for bit, unless that lies far from the origin.

    Attributes:
        name: its name in the scene.
        vertices: (V, 3) float32 in its own frame.
        faces: (F, 3) int64.
        normals: (V, 3) float32 unit, None where its faces are flat.
        uv: (V, 2) float32, origin top left, None where it has none.
        colours: (V, 3) float32 linear in [0, 1], None where the material reads none.
        to_world: (4, 4) float64, to the user frame.
        material: the nearest one that other tools know.
        moved: (3,) what was subtracted from the file's positions, and is in `to_world`, where 32 bits are too coarse.
        corrected: a PLY for Mitsuba in the shape's own frame, where Mitsuba would misread its own file, else None.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    colours: np.ndarray | None
    to_world: np.ndarray
    material: PbrMaterial
    corrected: bytes | None = None
    moved: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def in_user_frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Vertices (V, 3) float64, faces (F, 3) running outwards, and unit normals, all in the user frame."""
        linear = self.to_world[:3, :3]
        vertices = self.vertices.astype(np.float64) @ linear.T + self.to_world[:3, 3]
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        if self.normals is None:
            return vertices, faces, None
        normals = self.normals.astype(np.float64) @ np.linalg.inv(linear)
        return vertices, faces, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def base_shapes(scene: EditScene, file: SceneFile) -> list[BaseShape]:
    """Every shape of the base, in the order of the scene file, which is that of `scene.base`.

    Raises:
        UserError: a file of the scene that cannot be read any more.
    """
    shapes = []
    earlier = {part.shape: part for part in scene.earlier}
    for element, mesh in zip(scene.base_elements, scene.base, strict=True):
        bsdf = next((file.elements[i] for i in element.children.values() if file.elements[i].kind == "bsdf"), None)
        material = pbr_material(file, bsdf, mesh.name)
        if mesh.name in earlier:
            material = _as_exported(material, earlier[mesh.name], scene.path.parent)
        shapes.append(_shape(file, element, mesh.name, (mesh.vertices, mesh.faces), material))
    return shapes


def _as_exported(material: PbrMaterial, part: StackedPart, folder: Path) -> PbrMaterial:
    """An earlier part's material with what its Mitsuba scene cannot say, but the GLB of its own round did."""
    if material.base_picture is not None:
        material = replace(material, base_color=part.factor)
    path = part.normal_path(folder)
    if material.normal_picture is not None and path is not None:
        material = replace(material, normal_picture=Picture(path.stem, path.read_bytes(), wrap="clamp"))
    return material


def _shape(
    file: SceneFile,
    element: SceneElement,
    name: str,
    triangles: tuple[np.ndarray, np.ndarray],
    material: PbrMaterial,
) -> BaseShape:
    mi = file.mi
    plain = {key: value for key, value in element.properties.items() if key != "to_world"}
    loaded, differs = None, False
    if element.plugin not in ANALYTIC:
        with file.searching():
            loaded = mi.load_dict({"type": element.plugin, **plain}, optimize=False)
        differs = correct_mesh(file, element, loaded).differs
    parameters = mi.traverse(loaded) if isinstance(loaded, mi.Mesh) else {}
    if VERTICES not in parameters:  # an analytic shape: its triangles, which are in the user frame already
        vertices, moved = _near_origin(triangles[0])
        return BaseShape(name, vertices, triangles[1], None, None, None, _moved(moved), material, moved=moved)

    def rows(key: str, width: int) -> np.ndarray | None:
        values = np.array(parameters[key], dtype=np.float32) if key in parameters else np.zeros(0)
        return values.reshape(-1, width) if values.size else None

    vertices, moved = np.array(parameters[VERTICES], dtype=np.float32).reshape(-1, 3), np.zeros(3)
    if is_coarse(vertices):
        vertices, moved = _near_origin(double_positions(file.resolve(str(plain.get("filename", ""))), vertices))
    normals = None if plain.get("face_normals", False) else rows(NORMALS, 3)
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(np.abs(length - 1) < 1e-3, normals, normals / np.maximum(length, 1e-30))
        normals = np.where(length > 1e-6, normals, np.array([0, 1, 0], np.float32)).astype(np.float32)
    transform = element.properties.get("to_world")
    to_world = np.eye(4) if transform is None else np.array(getattr(transform, "matrix", transform), dtype=np.float64)
    faces, uv, colours = np.array(parameters[FACES]).astype(np.int64).reshape(-1, 3), rows(UVS, 2), None
    if material.colours in parameters:
        per_face = material.colours.startswith("face_")
        colours = np.array(parameters[material.colours], dtype=np.float32)
        colours = colours.reshape(len(faces) if per_face else len(vertices), -1)
        colours = colours[:, :3] if colours.shape[1] >= 3 else np.repeat(colours[:, :1], 3, axis=1)
        colours = np.clip(colours * np.float32(material.colour_scale), 0, 1)
        if per_face:  # other formats have colours at vertices only, so that each face gets its own
            corner = faces.ravel()
            vertices, uv = vertices[corner], None if uv is None else uv[corner]
            normals, colours = None if normals is None else normals[corner], np.repeat(colours, 3, axis=0)
            faces = np.arange(len(corner)).reshape(-1, 3)
    if _face_inwards(name, vertices, faces, bool(plain.get("flip_normals", False))):
        faces, normals = faces[:, ::-1], None if normals is None else -normals
    corrected = mesh_ply(mi, loaded) if differs else None
    to_world = to_world @ _moved(moved)
    return BaseShape(name, vertices, faces, normals, uv, colours, to_world, material, corrected, moved)


def _near_origin(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions as float32, and what was subtracted from them: the middle of their box where they lie far away."""
    moved = np.zeros(3)
    if is_coarse(vertices):
        moved = np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2)
    return (vertices - moved).astype(np.float32), moved


def _moved(by: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def _face_inwards(name: str, vertices: np.ndarray, faces: np.ndarray, flipped: bool) -> bool:
    """Whether the other way round is outwards: other formats have no `flip_normals`, and show no faces from behind."""
    mesh = TriangleMesh(name, vertices, faces)
    inwards = mesh.volume() < 0
    if inwards == flipped:
        return inwards
    return inwards if topology(mesh.vertices, mesh.faces).closed else flipped
