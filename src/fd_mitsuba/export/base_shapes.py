"""The base's shapes as Mitsuba reads them, with normals, UVs and colours, for formats that hold all in a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fd_mitsuba.backend.startup import FACES, VERTICES
from fd_mitsuba.export.material import PbrMaterial, pbr_material
from fd_mitsuba.export.pictures import Picture
from fd_mitsuba.scene.edit_scene import EditScene, base_elements
from fd_mitsuba.scene.mesh_source import ANALYTIC
from fd_mitsuba.scene.part_stack import StackedPart
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile

_NORMALS, _UV = "vertex_normals", "vertex_texcoords"


@dataclass(frozen=True)
class BaseShape:
    """One shape of the base; floats as in the file, bit for bit.

    Attributes:
        name: its name in the scene.
        vertices: (V, 3) float32 in its own frame.
        faces: (F, 3) int64.
        normals: (V, 3) float32 unit, None where its faces are flat.
        uv: (V, 2) float32, origin top left, None where it has none.
        colours: (V, 3) float32 linear, None where the material reads none.
        to_world: (4, 4) float64, to the user frame.
        material: the nearest one that other tools know.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    colours: np.ndarray | None
    to_world: np.ndarray
    material: PbrMaterial

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
    for element, mesh in zip(base_elements(file), scene.base, strict=True):
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
    loaded = None
    if element.plugin not in ANALYTIC:
        with file.searching():
            loaded = mi.load_dict({"type": element.plugin, **plain}, optimize=False)
    parameters = mi.traverse(loaded) if isinstance(loaded, mi.Mesh) else {}
    if VERTICES not in parameters:  # an analytic shape: its triangles, which are in the user frame already
        return BaseShape(name, triangles[0].astype(np.float32), triangles[1], None, None, None, np.eye(4), material)

    def rows(key: str, width: int) -> np.ndarray | None:
        values = np.array(parameters[key], dtype=np.float32) if key in parameters else np.zeros(0)
        return values.reshape(-1, width) if values.size else None

    vertices = rows(VERTICES, 3)
    normals = None if plain.get("face_normals", False) else rows(_NORMALS, 3)
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(np.abs(length - 1) < 1e-3, normals, normals / np.maximum(length, 1e-30))
        normals = np.where(length > 1e-6, normals, np.float32([0, 1, 0])).astype(np.float32)
    colours = None
    if material.vertex_colour in parameters:
        values = np.array(parameters[material.vertex_colour], dtype=np.float32).reshape(len(vertices), -1)
        colours = np.clip(values[:, :3] if values.shape[1] >= 3 else np.repeat(values[:, :1], 3, axis=1), 0, 1)
    transform = element.properties.get("to_world")
    to_world = np.eye(4) if transform is None else np.array(getattr(transform, "matrix", transform), dtype=np.float64)
    faces = np.array(parameters[FACES]).astype(np.int64).reshape(-1, 3)
    return BaseShape(name, vertices, faces, normals, rows(_UV, 2), colours, to_world, material)
