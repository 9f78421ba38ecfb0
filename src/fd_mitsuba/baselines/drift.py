"""What an edit changed where nothing was asked for: outside of the focal regions, in images, surfaces and volume."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from torch import Tensor

from fd_mitsuba.baselines.interface import EditedImages
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.evaluation.picture_difference import psnr
from fd_mitsuba.render.region_views import RegionViews
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch

SURFACE_POINTS = 20_000
_OFF_SURFACE = 1e-3
VOLUME_SIDE = 64
"""Points a side of the lattice that volumes are counted on."""


def outside_regions(scene: EditScene, cameras: CameraBatch, size: int, band: float) -> Tensor:
    """(N, 1, size, size) bool: pixels whose rays meet no focal region, each grown by `band`, even behind the base."""
    masks = RegionViews(scene.parts, size, band).render(cameras, 0)
    return torch.stack(list(masks.values())).sum(dim=0) == 0


def image_psnr(edited: EditedImages, base: EditedImages, outside: Tensor) -> float | None:
    """PSNR in dB over the pixels of `outside` in which either object is seen; None where there are none."""
    shown = (edited.mask > 0) | (base.mask > 0)
    return psnr(edited.rgb, base.rgb, outside & shown)


def surface_chamfer(edited: TriangleMesh, scene: EditScene, band: float, seed: int = 0) -> float | None:
    """Half the sum of the mean distances from either surface to the other, canonical units, outside of the regions.

    Each mean is over those of 20 000 points, uniform by area, that are further than `band` from every region. Of the
    edited object only what is on its outside counts: where two of its pieces reach into each other, as a part into the
    base that it is rooted in, the hidden surfaces are nobody's to see. None where one of the surfaces has no point.
    """
    base, means = scene.base_canonical, []
    for source, target in ((edited, base), (base, edited)):
        mesh = trimesh.Trimesh(source.vertices, source.faces, process=False)
        points, face = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=seed)[:2]
        kept = union_sdf(scene.regions, points) < -band
        if source is edited:
            just_outside = points + _OFF_SURFACE * mesh.face_normals[face]
            kept &= ~MeshDistance(edited.vertices, edited.faces).inside(just_outside)
        if not kept.any():
            return None
        means.append(float(MeshDistance(target.vertices, target.faces).unsigned(points[kept]).mean()))
    return sum(means) / 2


def leaked_share(edited: TriangleMesh, scene: EditScene, band: float, cell: float) -> float | None:
    """The share of what is new that lies outside of the regions, grown by `band`; None where nothing is new.

    New is a point of a lattice over the canonical cube that lies in the edited object and further than `cell` from
    the base: less is how finely a method knows the surface at all.
    """
    axis = np.linspace(-GRID_HALF_EXTENT, GRID_HALF_EXTENT, VOLUME_SIDE)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    low, high = edited.vertices.min(axis=0), edited.vertices.max(axis=0)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    points = points[MeshDistance(edited.vertices, edited.faces).inside(points)]
    base = scene.base_canonical
    points = points[MeshDistance(base.vertices, base.faces).signed(points) < -cell] if len(points) else points
    if not len(points):
        return None
    return float((union_sdf(scene.regions, points) <= -band).mean())
