"""Triangles of the shapes of a scene file in the user frame, with what is wrong with them in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fd_mitsuba.backend.parser_message import MITSUBA_ERRORS
from fd_mitsuba.conventions import BASE_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.file_gate import mark_sound
from fd_mitsuba.scene.mesh_diagnosis import mesh_fault, obj_concave_face
from fd_mitsuba.scene.mesh_source import FILE_SHAPES, BrokenMesh, NotAMesh, shape_triangles
from fd_mitsuba.scene.plugins import FOCAL_REGION, region_triangles
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

FOREIGN_MESHES = frozenset(".stl .glb .gltf .fbx .dae .off .3ds .blend .usd .usda .usdc .usdz .abc".split())
"""Suffixes of meshes that people have and Mitsuba does not read; of some its OBJ reader makes an empty mesh."""

_IMPORTED = (".stl", ".glb", ".gltf", ".dae", ".off")


def placement(element: SceneElement) -> np.ndarray:
    """A shape's `to_world`, (4, 4) float64.

    Raises:
        UserError: it is not finite, not affine or singular.
    """
    transform = element.properties.get("to_world")
    matrix = np.eye(4) if transform is None else np.array(getattr(transform, "matrix", transform), dtype=np.float64)
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise element.error("to_world holds NaN or infinity; correct its numbers")
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise element.error("to_world is not affine (its last row is not 0 0 0 1); correct its matrix")
    stretch = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if stretch[-1] <= 1e-9 * stretch[0]:
        raise element.error("to_world is singular (it flattens the shape); use scales other than 0")
    return matrix


def element_triangles(file: SceneFile, element: SceneElement) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in the user frame and faces (F, 3) of a shape or a focal region.

    Raises:
        UserError: it has none that can be used, in one line with file, element and remedy.
    """
    to_world = placement(element)
    filename = element.properties.get("filename")
    plain = {name: value for name, value in element.properties.items() if name != "to_world"}
    if filename:
        plain["filename"] = str(file.resolve(filename))
    subject = f"{filename}: " if filename else ""
    try:
        with file.searching():
            if element.plugin == FOCAL_REGION:
                return region_triangles(file.mi, plain, to_world)
            triangles = shape_triangles(file.mi, element.plugin, plain, to_world)
            if element.plugin in FILE_SHAPES.values():
                mark_sound(file, element)
            return triangles
    except UserError as error:
        raise element.error(str(error)) from None
    except NotAMesh:
        raise element.error("cannot be turned into a mesh; use a mesh or a sphere, disk or cylinder") from None
    except BrokenMesh as error:
        fault = mesh_fault(file.resolve(filename)) if filename else None
        raise element.error(f"{subject}{fault or f'{error}; repair the mesh and save it anew'}") from None
    except MITSUBA_ERRORS as error:
        if filename and (fault := mesh_fault(file.resolve(filename))):
            raise element.error(f"{subject}{fault}") from None
        problem = str(file.translated(error)).removeprefix(f"{file.path}: ")
        raise element.error(f"{subject}{problem}") from None
    except ValueError as error:
        raise element.error(f"{error}; save it as one of these") from None


def base_mesh(file: SceneFile, element: SceneElement) -> TriangleMesh:
    """The mesh of a shape that is edited, user frame.

    Raises:
        UserError: as `element_triangles`; a format that Mitsuba does not read, faces that it reads wrongly.
    """
    filename = element.properties.get("filename")
    if filename and Path(filename).suffix.lower() in FOREIGN_MESHES:
        name = Path(filename).name
        imported = name if Path(filename).suffix.lower() in _IMPORTED else f"{Path(filename).stem}.glb"
        first = "" if imported == name else "save it as GLB, as from Blender, and "
        raise element.error(
            f"{filename}: Mitsuba reads PLY, OBJ and serialized meshes; {first}make a scene of it: "
            f"fd_mitsuba import {imported} -o FOLDER"
        )
    vertices, faces = element_triangles(file, element)
    if filename and Path(filename).suffix.lower() == ".obj":
        concave = obj_concave_face(file.resolve(filename))
        if concave is not None:
            raise element.error(
                f"{filename}: face {concave} is not convex, and Mitsuba cuts it into triangles that lie outside of it; "
                "triangulate the mesh as you export it"
            )
    sources = (file.resolve(filename),) if filename else ()
    return TriangleMesh(element.id or BASE_NAME, vertices, faces, sources)
