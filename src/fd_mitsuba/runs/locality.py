"""How local an edit is: which share of the part lies where the user asked for it, and which inside the base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fd_mitsuba.scene.focal_region import FocalRegion, union_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance


@dataclass(frozen=True)
class Locality:
    """Attributes:
    part_volume: canonical units cubed.
    inside_fraction: share of the part's volume in the focal regions or within the free band around them.
    overlap_fraction: share of the part's volume inside the base.
    """

    part_volume: float
    inside_fraction: float
    overlap_fraction: float


def measure_locality(
    part: tuple[np.ndarray, np.ndarray],
    base: tuple[np.ndarray, np.ndarray],
    regions: tuple[FocalRegion, ...],
    band: float,
    samples: int = 64,
) -> Locality:
    """Counts of a regular lattice over the part's bounding box, `samples` points along its longest side.

    Args:
        part, base: (vertices, faces), canonical frame. Inside is decided by winding numbers, not by the fields that
            were trained, so this measures what is exported.
        regions: the focal regions, canonical frame.
        band: free distance around the regions, canonical units.
    """
    vertices, faces = part
    if len(faces) == 0:
        return Locality(0.0, 0.0, 0.0)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = float((high - low).max()) / samples
    if step == 0:
        return Locality(0.0, 0.0, 0.0)
    axes = [low[i] + step * (np.arange(max(1, np.ceil((high[i] - low[i]) / step))) + 0.5) for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[MeshDistance(vertices, faces).inside(points)]
    if len(points) == 0:
        return Locality(0.0, 0.0, 0.0)
    near = union_sdf(regions, points) > -band
    within = MeshDistance(*base).inside(points)
    return Locality(len(points) * step**3, float(near.mean()), float(within.mean()))
