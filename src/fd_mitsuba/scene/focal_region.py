"""A focal region: where the part may grow, as an ellipsoid or a closed mesh in the canonical frame."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.scene.ellipsoid import ellipsoid_sdf
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

ADD, SUBTRACT = "add", "subtract"
"""The modes of a region: its part joins the base, or is cut out of it."""
_SURFACE_POINTS = 4096


@dataclass(frozen=True)
class PartPrompt:
    """What one part is to become.

    Attributes:
        prompt: never blank.
        negative_prompt: what to keep away from; "": what the scene says.
    """

    prompt: str
    negative_prompt: str = ""


@dataclass(frozen=True)
class FocalRegion:
    """One region Omega'; the union of a part's regions is where that part starts and stays.

    Attributes:
        name: the shape's id in the scene file.
        to_canonical: (4, 4) float64 affine map that is not singular, from the shape's own coordinates to the canonical
            frame. An ellipsoid is the image of the unit sphere (radius 1, centre 0) under it.
            Source: the paper, "Focal Region"; deviates: any affine map, not only R, T and S in a fixed order.
        part: name of the editable part that it belongs to.
        mesh: None for an ellipsoid, else the closed mesh, vertices in the canonical frame.
        mode: `ADD` or `SUBTRACT`.
        prompt: of its own; None: that of its part, or the scene's.
    """

    name: str
    to_canonical: np.ndarray
    part: str = DEFAULT_PART_NAME
    mesh: TriangleMesh | None = None
    mode: str = ADD
    prompt: PartPrompt | None = None

    def __post_init__(self) -> None:
        matrix = np.array(self.to_canonical, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
            raise ValueError(f"region {self.name!r}: to_canonical must be a finite 4x4 matrix")
        matrix.setflags(write=False)
        object.__setattr__(self, "to_canonical", matrix)

    @property
    def is_ellipsoid(self) -> bool:
        return self.mesh is None

    @property
    def centre(self) -> np.ndarray:
        """(3,) centre of the bounds, canonical frame."""
        low, high = self.bounds
        return (low + high) / 2

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner (3,) of the axis-aligned box around the region, canonical frame; exact."""
        if self.mesh is not None:
            return self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        reach = np.linalg.norm(self.to_canonical[:3, :3], axis=1)
        return self.to_canonical[:3, 3] - reach, self.to_canonical[:3, 3] + reach

    @property
    def size(self) -> float:
        """Longest side of the bounds, canonical units."""
        low, high = self.bounds
        return float((high - low).max())

    @property
    def volume(self) -> float:
        """Enclosed volume in cubic canonical units."""
        if self.mesh is not None:
            return abs(self.mesh.volume())
        return float(4.0 / 3.0 * np.pi * abs(np.linalg.det(self.to_canonical[:3, :3])))

    @property
    def thickness(self) -> float:
        """The region's thinnest extent in canonical units: the shortest axis, or twice the deepest sampled point."""
        if self.mesh is None:
            return float(2.0 * np.linalg.svd(self.to_canonical[:3, :3], compute_uv=False)[-1])
        low, high = self.bounds
        axes = [np.linspace(a, b, 26)[1:-1] for a, b in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return float(max(2.0 * self.sdf(points).max(), 0.0))

    def seen_from(self, change: np.ndarray) -> FocalRegion:
        """The same region in another canonical frame; `change` (4, 4) is the affine map from this one to that."""
        mesh = self.mesh
        if mesh is not None:
            mesh = replace(mesh, vertices=mesh.vertices @ change[:3, :3].T + change[:3, 3])
        return replace(self, to_canonical=change @ self.to_canonical, mesh=mesh)

    def has_inside(self) -> bool:
        """Whether any point just beside the middle of a face is within the region."""
        surface = self.surface(2)
        corners = surface.vertices[surface.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        step = 1e-3 * self.size * normal / np.where(length > 0, length, 1)
        middle = corners.mean(axis=1)
        return bool((self.sdf(np.concatenate([middle - step, middle + step])) > 0).any())

    def sdf(self, points: np.ndarray) -> np.ndarray:
        """(N,) float32 exact signed distance to the region's surface, inside positive.

        Args:
            points: (N, 3) canonical frame.
        """
        if self.mesh is None:
            return ellipsoid_sdf(points, self.to_canonical)
        return self._distance.signed(points).astype(np.float32)

    def surface(self, subdivisions: int = 4) -> TriangleMesh:
        """The region's surface in the canonical frame, faces outward: its own mesh, or the sphere split and mapped."""
        if self.mesh is not None:
            return self.mesh
        vertices, faces = unit_sphere(subdivisions)
        linear = self.to_canonical[:3, :3]
        if np.linalg.det(linear) < 0:
            faces = faces[:, ::-1]
        return TriangleMesh(self.name, vertices @ linear.T + self.to_canonical[:3, 3], faces)

    def surface_points(self) -> np.ndarray:
        """(N, 3) points all over the region's surface, canonical frame; of a mesh not its vertices alone."""
        if self.mesh is None:
            return self.surface(3).vertices
        corners = self.mesh.vertices[self.mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        random = np.random.default_rng(0)
        chosen = random.choice(len(corners), size=_SURFACE_POINTS, p=area / area.sum())
        weights = random.dirichlet([1.0, 1.0, 1.0], size=_SURFACE_POINTS)
        return np.concatenate([self.mesh.vertices, np.einsum("ij,ijk->ik", weights, corners[chosen])])

    @cached_property
    def _distance(self) -> MeshDistance:
        assert self.mesh is not None
        return MeshDistance(self.mesh.vertices, self.mesh.faces)


def union_sdf(regions: tuple[FocalRegion, ...] | list[FocalRegion], points: np.ndarray) -> np.ndarray:
    """(N,) float32 largest of the regions' SDFs at `points` (N, 3), canonical frame, inside positive.

    Exact outside of all regions; inside an overlap it is a lower bound of the depth. Source: the paper's maximum.
    """
    result = regions[0].sdf(points)
    for region in regions[1:]:
        result = np.maximum(result, region.sdf(points))
    return result


def deepest_in(points: np.ndarray, parts: Iterable[Sequence[FocalRegion]]) -> np.ndarray:
    """(N,) int64: which part points (N, 3) belong to: in whose regions they lie deepest, or which are nearest."""
    return np.argmax([union_sdf(list(regions), points) for regions in parts], axis=0)
