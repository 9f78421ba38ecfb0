"""The meshes that turntables show: the base as its files have it, not as a grid of the run sees it."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from fd_mitsuba.export.cut_shapes import CutBase
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.viewing.turntable import Mesh

_CREASE_DEG = 75.0


def base_mesh(scene: EditScene) -> Mesh:
    """The base's own triangles in the canonical frame, with its sharp edges sharp."""
    return joined([_shown(scene, mesh.vertices, mesh.faces) for mesh in scene.base])


def edited_mesh(scene: EditScene, part: Solid, cut: CutBase | None) -> Mesh:
    """The edited object as it is exported: the base's own triangles with the part, or what a cut left of them."""
    if cut is None:
        return joined([base_mesh(scene), as_mesh(part.vertices, part.faces)])
    return joined([_shown(scene, *shape.in_user_frame()[:2]) for shape in cut.shapes if shape is not None])


def start_mesh(scene: EditScene) -> Mesh:
    """The base's own triangles with the focal regions as they are."""
    regions = [region.surface(4) for region in scene.regions]
    return joined([base_mesh(scene), *(as_mesh(region.vertices, region.faces) for region in regions)])


def as_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Arrays (V, 3), (F, 3) as tensors."""
    return torch.from_numpy(np.array(vertices, np.float32)), torch.from_numpy(np.array(faces, np.int64))


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one; nothing is welded."""
    vertices: list[Tensor] = []
    faces: list[Tensor] = []
    count = 0
    for own_vertices, own_faces in meshes:
        vertices.append(own_vertices)
        faces.append(own_faces + count)
        count += len(own_vertices)
    return torch.cat(vertices), torch.cat(faces)


def creased(vertices: np.ndarray, faces: np.ndarray, degrees: float = _CREASE_DEG) -> tuple[np.ndarray, np.ndarray]:
    """The same triangles with vertices that only faces share which meet there at less than `degrees`.

    Equal positions are one vertex first, so that a seam of UVs is no edge.
    """
    rows, weld = np.unique(np.asarray(vertices) + 0.0, axis=0, return_inverse=True)
    welded = weld.reshape(-1)[faces]
    corners = rows[welded]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    # Half-edge k of a face runs from its corner k to the next one; those of one edge are neighbours after sorting.
    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    one, other = order[:-1][same], order[1:][same]
    smooth = np.einsum("ij,ij->i", normal[one // 3], normal[other // 3]) > np.cos(np.radians(degrees))
    one, other = one[smooth], other[smooth]
    ends = [(half, half // 3 * 3 + (half + 1) % 3) for half in (one, other)]
    turned = start[one] != start[other]  # as in a mesh whose faces agree
    first = (ends[0][0], np.where(turned, ends[1][1], ends[1][0]))
    second = (ends[0][1], np.where(turned, ends[1][0], ends[1][1]))
    links = np.concatenate([np.stack(first, axis=1), np.stack(second, axis=1)])
    count = faces.size
    graph = coo_array((np.ones(len(links), dtype=np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    _, chosen = np.unique(label, return_index=True)
    return rows[welded.ravel()[chosen]], label.reshape(-1, 3)


def _shown(scene: EditScene, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Of the user frame; turned round where its faces point inwards."""
    if TriangleMesh("", vertices, faces).volume() < 0:
        faces = faces[:, ::-1]
    return as_mesh(*creased(scene.frame.to_canonical(vertices), faces))
