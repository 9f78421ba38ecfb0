"""Which shapes of a scene are edited, and which are surroundings: floor, walls, other objects, curves, instances."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fd_mitsuba.scene.base_mesh import base_mesh
from fd_mitsuba.scene.edit_inputs import EditInputs
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.mesh_source import ANALYTIC, FILE_SHAPES
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.part_stack import is_part, read_stack
from fd_mitsuba.scene.plugins import FOCAL_REGION
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

_MESHES = frozenset((*ANALYTIC, *FILE_SHAPES.values(), "cube"))
_FLAT = 1e-4
"""Thickness over extent of a shape that only closes off a room."""
_SLACK = 1e-3
"""Of the extent of a box, how far beyond it something may reach and still be within."""
_SAME_OBJECT = 0.5
"""Share of a shape's box within that of the shapes that regions touch, from which it belongs to the same object."""


@dataclass(frozen=True)
class BaseChoice:
    """The shapes of a scene file in its order, regions and area lights apart.

    Attributes:
        base: those that are edited.
        meshes: theirs, user frame.
        surroundings: all others: they are lit, cast shadows and reflect, and are no part of SDF, frame or normals.
        how: a line that tells what was chosen where the scene does not say; else "".
    """

    base: tuple[SceneElement, ...]
    meshes: tuple[TriangleMesh, ...]
    surroundings: tuple[SceneElement, ...] = ()
    how: str = ""


def choose_base(
    inputs: EditInputs, regions_in: Callable[[Normalisation], Sequence[FocalRegion]] | None = None
) -> BaseChoice:
    """The shapes that the integrator's `base` names.

    Without it: all shapes, if each is a mesh that is not flat. A floor, a wall or a curve tells that the object is not
    alone: then those that the regions touch, and what lies within their box, such as a pot's lid, a window's pane or an
    animal's eyes.

    Args:
        regions_in: the focal regions in a frame that is given; None: there are none to go by.

    Raises:
        UserError: `base` names no shape of the scene, or a lamp; a shape of the base that is no usable mesh.
    """
    file = inputs.scene
    shapes = shapes_without_lamps(file)
    named = inputs.base_names()
    if named is not None:
        element, names = named
        _refuse_unknown(element, names, file, shapes)
        chosen = {i: base_mesh(file, item) for i, item in enumerate(shapes) if item.id in names or is_part(item.id)}
        return _choice(shapes, chosen)
    known = read_stack(file.path.parent)[1].get("surroundings", [])
    if known:  # an exported scene, which is edited again
        return _choice(shapes, {i: base_mesh(file, item) for i, item in enumerate(shapes) if item.id not in known})
    meshes = {i: base_mesh(file, item) for i, item in enumerate(shapes) if item.plugin in _MESHES}
    solid = {i: mesh for i, mesh in meshes.items() if not _is_flat(mesh)}
    if len(solid) == len(shapes):
        return _choice(shapes, solid)
    if not solid:  # whatever is wrong with them is told as if they were all
        return _choice(shapes, {i: base_mesh(file, item) for i, item in enumerate(shapes)})
    chosen = solid if regions_in is None else _touched(solid, regions_in)
    own = chosen | _enclosed({i: mesh for i, mesh in meshes.items() if i not in solid}, chosen)
    choice = _choice(shapes, {i: own[i] for i in sorted(own)})
    if not choice.surroundings:
        return choice
    how = (
        f"edited: {_names(choice.base)}; surroundings: {_names(choice.surroundings)} "
        '(<string name="base" value="ids, separated by commas"/> in dual_path chooses others)'
    )
    return replace(choice, how=how)


def shapes_without_lamps(file: SceneFile) -> list[SceneElement]:
    """The shapes in file order that are neither regions nor area lights."""

    def emits(element: SceneElement) -> bool:
        return any(file.elements[child].kind == "emitter" for child in element.children.values())

    return [item for item in file.top_level("shape") if item.plugin != FOCAL_REGION and not emits(item)]


def _choice(shapes: Sequence[SceneElement], chosen: Mapping[int, TriangleMesh]) -> BaseChoice:
    base = tuple(item for i, item in enumerate(shapes) if i in chosen)
    return BaseChoice(base, tuple(chosen.values()), tuple(item for i, item in enumerate(shapes) if i not in chosen))


def _touched(
    solid: Mapping[int, TriangleMesh], regions_in: Callable[[Normalisation], Sequence[FocalRegion]]
) -> dict[int, TriangleMesh]:
    frame = Normalisation.of_points(np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in solid.values()]))
    regions = regions_in(frame)
    if not regions:
        return dict(solid)
    vertices = {i: frame.to_canonical(mesh.vertices[np.unique(mesh.faces)]) for i, mesh in solid.items()}
    distances = {i: MeshDistance(frame.to_canonical(mesh.vertices), mesh.faces) for i, mesh in solid.items()}
    touched: set[int] = set()
    for region in regions:
        gaps = {i: _gap(region, distances[i], vertices[i]) for i in solid}
        touched |= {i for i, gap in gaps.items() if gap <= min(gaps.values())}
    points = np.concatenate([vertices[i] for i in sorted(touched)])
    low, high = points.min(axis=0), points.max(axis=0)
    within = {i for i in solid if _share_within(vertices[i], low, high) >= _SAME_OBJECT}
    return {i: mesh for i, mesh in solid.items() if i in touched | within}


def _enclosed(flat: Mapping[int, TriangleMesh], solid: Mapping[int, TriangleMesh]) -> dict[int, TriangleMesh]:
    """The flat shapes that lie wholly within the box of solid ones: a pane or a label, but no floor."""
    if not solid or not flat:
        return {}
    corners = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in solid.values()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    slack = _SLACK * float((high - low).max())
    used = {i: mesh.vertices[np.unique(mesh.faces)] for i, mesh in flat.items()}
    within = {i for i, own in used.items() if (own >= low - slack).all() and (own <= high + slack).all()}
    return {i: mesh for i, mesh in flat.items() if i in within}


def _gap(region: FocalRegion, distance: MeshDistance, vertices: np.ndarray) -> float:
    """From the region's surface to the mesh's, 0 where they cross; a region within a room is not at its walls."""
    surface = region.surface_points()
    inside = distance.inside(surface)
    if inside.any() and not inside.all():
        return 0.0
    return max(min(float(distance.unsigned(surface).min()), float(-region.sdf(vertices).max())), 0.0)


def _share_within(vertices: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Of the vertices' box, the share within the box from `low` to `high`."""
    own_low, own_high = vertices.min(axis=0), vertices.max(axis=0)
    common = np.clip(np.minimum(high, own_high) - np.maximum(low, own_low), 0, None)
    return float(np.prod(common / np.maximum(own_high - own_low, 1e-12)))


def _is_flat(mesh: TriangleMesh) -> bool:
    used = mesh.vertices[np.unique(mesh.faces)]
    spread = np.linalg.eigvalsh(np.cov(used.T))
    return bool(spread[0] <= _FLAT**2 * spread[-1])


def _refuse_unknown(
    element: SceneElement, names: Sequence[str], file: SceneFile, shapes: Sequence[SceneElement]
) -> None:
    known = [item.id for item in shapes if item.id]
    for name in names:
        if name in known:
            continue
        if any(item.id == name for item in file.top_level("shape")):
            raise element.error(f"base {name!r} is a lamp or a region; name the shapes to edit, of {', '.join(known)}")
        near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        hint = f"nearest: {', '.join(near)}" if near else f"its shapes: {', '.join(known) or 'none has an id'}"
        raise element.error(f"base {name!r}: no shape of {file.path.name} has this id; {hint}")


def _names(elements: Sequence[SceneElement]) -> str:
    return ", ".join(item.id or f"a {item.plugin}" for item in elements)
