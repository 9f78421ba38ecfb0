"""Whether edited views show one object: how much of what is new in a view the other views leave room for.

What is new in a view is its *new silhouette*: pixels that the edited object covers and the base does not. The other
views' silhouettes are lifted into a visual hull: the points outside the base that each of them sees either within its
own new silhouette or at a pixel of the base, which may hide them. A pixel of the view is explained if its ray meets
that hull. Views of one object explain each other up to the lattice's cells; views that were edited one by one need not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch

LATTICE_SIDE = 96
COVERED = 0.5


@dataclass(frozen=True)
class ViewConsistency:
    """Attributes:
    explained: share of all new pixels that the other views explain; None where no view shows anything new.
    per_view: (N,) the same of each view, NaN where it shows nothing new.
    new_pixels: (N,) how many pixels of each view are new.
    """

    explained: float | None
    per_view: np.ndarray
    new_pixels: np.ndarray


def view_consistency(edited: Tensor, base: Tensor, cameras: CameraBatch, mesh: TriangleMesh) -> ViewConsistency:
    """How well N views explain each other.

    Args:
        edited, base: (N, 1, S, S) coverage of the edited and of the unedited object, in [0, 1].
        cameras: the N cameras.
        mesh: the base, canonical frame.
    """
    size, count = edited.shape[-1], len(cameras)
    new = (edited > COVERED) & (base <= COVERED)
    # Pixels at the rim are neither surely in nor out: views may differ by one.
    allowed = max_pool2d((new | (base > 0)).float(), 3, stride=1, padding=1) > 0
    axis = np.linspace(-GRID_HALF_EXTENT, GRID_HALF_EXTENT, LATTICE_SIDE)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    films = [_film(points, cameras, view, size) for view in range(count)]
    may = np.stack([_at(allowed[view, 0].numpy(), films[view], True) for view in range(count)])
    refused = (~may).sum(axis=0)
    # A point that two views refuse is in no hull of all but one.
    left = np.flatnonzero(refused <= 1)
    left = left[~MeshDistance(mesh.vertices, mesh.faces).inside(points[left])]
    shares, explained, total = np.full(count, np.nan), 0, 0
    pixels = new[:, 0].flatten(1).sum(dim=1).numpy()
    for view in range(count):
        hull = left[refused[left] - ~may[view, left] == 0]
        shadow = torch.zeros(1, size, size)
        cell, seen = _cells(films[view][hull], size)
        shadow[0, cell[seen, 1], cell[seen, 0]] = 1
        shadow = max_pool2d(shadow, 3, stride=1, padding=1)[0] > 0
        met = int((new[view, 0] & shadow).sum())
        if pixels[view]:
            shares[view] = met / pixels[view]
        explained, total = explained + met, total + int(pixels[view])
    return ViewConsistency(explained / total if total else None, shares, pixels)


def _film(points: np.ndarray, cameras: CameraBatch, view: int, size: int) -> np.ndarray:
    """(P, 2) pixel coordinates of points in one view."""
    right, up, back = (axis[view].astype(np.float64) for axis in cameras.basis())
    offset = points - cameras.position[view]
    scale = 0.5 * size / (-(offset @ back) * np.tan(np.radians(float(cameras.fov_deg[view])) / 2))
    return np.stack([0.5 * size + offset @ right * scale, 0.5 * size - offset @ up * scale], axis=1)


def _cells(film: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    cell = np.floor(film).astype(np.int64)
    seen = np.asarray(((cell >= 0) & (cell < size)).all(axis=1))
    return cell.clip(0, size - 1), seen


def _at(image: np.ndarray, film: np.ndarray, beyond: bool) -> np.ndarray:
    """Values (P,) of an image at film points; `beyond` where a point is out of sight."""
    cell, seen = _cells(film, len(image))
    return np.where(seen, image[cell[:, 1], cell[:, 0]], beyond)
