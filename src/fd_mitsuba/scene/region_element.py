"""A focal region read from its element in a scene file."""

from __future__ import annotations

from fd_mitsuba.scene.base_mesh import element_triangles, placement
from fd_mitsuba.scene.doubled_faces import without_reversed_copies
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.region_mode import region_mode
from fd_mitsuba.scene.region_prompt import region_prompt
from fd_mitsuba.scene.region_shapes import ELLIPSOID
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology


def read_region(file: SceneFile, element: SceneElement, index: int, part: str, frame: Normalisation) -> FocalRegion:
    """The focal region of an element in a canonical frame.

    Args:
        index: of the element among the regions, for one without an id.
        part: what it grows.

    Raises:
        UserError: it has no volume or no inside, or its mesh is not closed.
    """
    to_world = placement(element)
    name = element.id or f"region_{index + 1}"
    mesh = None
    filename = element.properties.get("filename")
    vertices, faces = element_triangles(file, element)
    if filename:
        if not topology(vertices, faces).closed:
            raise element.error(f"{filename}: the region's mesh is not closed; fill its holes, or use an ellipsoid")
        twice = len(faces) - len(without_reversed_copies(vertices, faces))
        if twice:
            problem = f"{twice} faces of the region's mesh are there twice, once each way round"
            raise element.error(f"{filename}: {problem}; remove the copies")
    if filename or element.properties.get("shape", ELLIPSOID) != ELLIPSOID:
        sources = (file.resolve(filename),) if filename else ()
        mesh = TriangleMesh(name, frame.to_canonical(vertices), faces, sources)
    region = FocalRegion(name, frame.matrix() @ to_world, part, mesh, region_mode(element), region_prompt(element))
    if not region.volume > 0:
        raise element.error("the region has no volume; enlarge it")
    if mesh is not None and not region.has_inside():
        problem = "the region's mesh has no inside, because pieces of it cancel each other"
        raise element.error(f"{filename}: {problem}; make the faces of all pieces point outwards")
    return region
