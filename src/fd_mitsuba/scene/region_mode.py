"""What a focal region is for: to add a part to the base, or to cut the part out of it."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.scene.focal_region import ADD, SUBTRACT, FocalRegion
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.scene_file import SceneElement
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology

_REACH = 0.15
"""How far beyond its regions a part may grow: that of `extraction.surface`, a later layer."""


def region_mode(element: SceneElement) -> str:
    """The region's `mode`, `ADD` unless the scene says otherwise; UserError for anything unknown."""
    mode = element.properties.get("mode", ADD)
    if mode not in (ADD, SUBTRACT):
        raise element.error(f"mode {mode!r} is unknown; write {ADD!r} or {SUBTRACT!r}")
    return str(mode)


def cut_faces_name(part: str) -> str:
    """What the faces are called that cutting a part out makes: as a shape, in files, nodes and groups."""
    return f"cut_face_{part}"


def check_modes(
    elements: list[SceneElement],
    regions: tuple[FocalRegion, ...],
    base: tuple[TriangleMesh, ...],
    frame: Normalisation,
) -> None:
    """Refuse regions that disagree, and cuts that cannot be made.

    Args:
        elements: of the regions, in their order.
        base: the meshes in the user frame.

    Raises:
        UserError: adding and subtracting in one scene; a cut that takes all of the base, comes near a mesh
            that encloses nothing, or whose faces would have the name of a base shape.
    """
    for element, region in zip(elements, regions, strict=True):
        if region.mode != regions[0].mode:
            both = f"{region.mode}s, while {regions[0].name!r} {regions[0].mode}s"
            if region.part == regions[0].part:
                raise element.error(f"{both}, and both are of part {region.part!r}; give them one mode")
            raise element.error(f"{both}; give all regions one mode, and edit in two runs")
        taken = {mesh.name.lower(): mesh.name for mesh in base}
        if region.mode == SUBTRACT and (clash := taken.get(cut_faces_name(region.part).lower())):
            raise element.error(
                f"cutting out part {region.part!r} makes a second shape {clash!r}; give another part name"
            )
    if not regions or regions[0].mode != SUBTRACT:
        return
    left = False
    for mesh in base:
        points = frame.to_canonical(mesh.vertices)
        near = False
        for element, region in zip(elements, regions, strict=True):
            if not near and _reaches(region, points, mesh):
                near = True
                _check_solid(element, mesh)
        within = np.any([region.sdf(points) > 0 for region in regions], axis=0)
        left = left or not near or not bool(within.all())
    if not left:
        raise elements[0].error("takes all of the base away; shrink it")


def _reaches(region: FocalRegion, points: np.ndarray, mesh: TriangleMesh) -> bool:
    """Whether a part of that region can touch the mesh, whose canonical vertices are `points`."""
    if float(region.sdf(points).max()) > -_REACH:
        return True
    return float(MeshDistance(points, mesh.faces).unsigned(region.surface_points()).min()) < _REACH


def _check_solid(element: SceneElement, mesh: TriangleMesh) -> None:
    found = topology(mesh.vertices, mesh.faces)
    if not found.closed or found.nonmanifold_edges:
        problem = f"is not closed ({found.boundary_edges} boundary edges)"
        if not found.boundary_edges:
            problem = f"has {found.misoriented_edges} edges whose faces point opposite ways"
        if found.nonmanifold_edges:
            problem = f"has {found.nonmanifold_edges} edges of more than two faces"
        raise element.error(f"base {mesh.name!r} {problem}, so nothing can be cut out of it; repair it")
    if not mesh.volume() > 0:
        raise element.error(f"base {mesh.name!r} has its faces pointing inwards, so nothing can be cut; flip them")
