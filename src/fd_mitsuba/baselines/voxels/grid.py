"""A ReLU-field voxel grid and its volume rendering, in plain torch.

    raw(x)   = trilinear interpolation of the values at the grid's vertices
    sigma(x) = softplus(raw_density(x)) / spacing          (per canonical unit of length)
    n(x)     = raw_normal(x) / max(|raw_normal(x)|, 1)      (world space)

The non-linear function comes after the interpolation, as in ReLU fields (arXiv 2205.10824), so that an edge may lie
within a voxel. A ray is cut into equal pieces of length d, and of piece i at x_i

    alpha_i = 1 - exp(-sigma(x_i) d),   T_i = prod over j < i of (1 - alpha_j),   w_i = T_i alpha_i
    coverage = sum w_i,   expected normal = sum w_i n(x_i)

Where Vox-E has a colour a voxel (spherical harmonics of degree 0), this grid has a normal a voxel: images for the
guidance of shapes show normals and coverage, not colours. A grid may have colours instead, before a plain background:

    c(x) = sigmoid(raw_colour(x)),   expected colour = sum w_i c(x_i) + (1 - coverage) background
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import grid_sample, softplus

from fd_mitsuba.baselines.interface import ImageKind
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.scene.views import CameraBatch

EMPTY = -8.0
"""Raw density of space without anything: a ray through a grid of 64 voxels loses two per cent, and what is empty still
has a gradient."""


class VoxelGrid(nn.Module):
    """Density and a feature vector at the vertices of a cubic lattice over the grid's cube.

    Args:
        resolution: vertices a side.
        features: numbers at each vertex beside the density.
        half_extent: the cube is [-half_extent, half_extent]^3 of the canonical frame; outside of it there is nothing.
        kind: what the features are.
        background: sRGB grey behind colours; black behind normals.

    Attributes:
        density: (R, R, R) raw, indexed z, y, x.
        features: (F, R, R, R) raw.
    """

    def __init__(
        self,
        resolution: int,
        features: int = 3,
        half_extent: float = GRID_HALF_EXTENT,
        kind: ImageKind = "normals",
        background: float = 0.0,
    ) -> None:
        super().__init__()
        self.resolution, self.half_extent = resolution, half_extent
        self.kind: ImageKind = kind
        self.background = background
        self.density = nn.Parameter(torch.full((resolution,) * 3, EMPTY))
        self.features = nn.Parameter(torch.zeros(features, resolution, resolution, resolution))

    @property
    def spacing(self) -> float:
        """Distance of neighbouring vertices, canonical units."""
        return 2 * self.half_extent / (self.resolution - 1)

    def vertices(self) -> Tensor:
        """(R R R, 3) canonical positions, x fastest, as `density.view(-1)` has the values."""
        axis = torch.linspace(-self.half_extent, self.half_extent, self.resolution)
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        return torch.stack([x, y, z], dim=-1).view(-1, 3)

    def sigma(self, raw: Tensor) -> Tensor:
        """Extinction per canonical unit of raw densities of any shape; gradients flow."""
        return softplus(raw) / self.spacing

    def raw_of_alpha(self, alpha: float) -> float:
        """The raw density at which a piece of one voxel's length covers the share `alpha`."""
        return float(np.log(np.expm1(-np.log1p(-alpha))))

    def shown(self, features: Float[Tensor, "F N"]) -> Float[Tensor, "F N"]:
        """n(x) or c(x) of the formulas above, of raw features; gradients flow."""
        if self.kind == "colour":
            return features.sigmoid()
        # By its square: torch's norm across rows takes a fifth of a whole step.
        return features * features.square().sum(dim=0).clamp(min=1).rsqrt()

    def lookup(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, " N"], Float[Tensor, "F N"]]:
        """Raw density and features at points within the cube; gradients flow to the grid."""
        return interpolated(self.density[None], points, self.half_extent)[0], interpolated(
            self.features, points, self.half_extent
        )


def interpolated(values: Float[Tensor, "C R R R"], points: Float[Tensor, "N 3"], half_extent: float) -> Tensor:
    """Trilinear interpolation (C, N) of values at a lattice's vertices (z, y, x); gradients flow to them."""
    place = (points / half_extent).to(values.dtype).view(1, 1, 1, -1, 3)
    return grid_sample(values[None], place, mode="bilinear", padding_mode="border", align_corners=True).view(
        len(values), -1
    )


@dataclass(frozen=True)
class Rays:
    """The parts of N rays that lie within the cube.

    Attributes:
        origin, direction: (N, 3) canonical; directions of length 1.
        near, far: (N,) distances along them; equal where a ray misses the cube.
    """

    origin: Tensor
    direction: Tensor
    near: Tensor
    far: Tensor

    def chosen(self, rows: slice | Tensor) -> Rays:
        """Some of the rays."""
        return Rays(self.origin[rows], self.direction[rows], self.near[rows], self.far[rows])


def rays_of(cameras: CameraBatch, size: int, half_extent: float, jitter: Tensor | None = None) -> Rays:
    """A ray for each pixel of B views of size x size, view after view, row after row from the top.

    Args:
        jitter: (B size size, 2) in [0, 1): where in its pixel a ray starts; None: in the middle.
    """
    right, up, back = (torch.from_numpy(axis) for axis in cameras.basis())
    count = len(cameras)
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    film = torch.stack([column, row], dim=-1).view(1, -1, 2).expand(count, -1, -1).float()
    film = film + (0.5 if jitter is None else jitter.view(count, -1, 2))
    half_width = torch.from_numpy(np.tan(np.radians(cameras.fov_deg) / 2)).view(-1, 1, 1)
    slope = (film * (2.0 / size) - 1.0) * half_width
    direction = slope[..., :1] * right[:, None] - slope[..., 1:] * up[:, None] - back[:, None]
    direction = torch.nn.functional.normalize(direction.reshape(-1, 3), dim=1)
    origin = torch.from_numpy(np.array(cameras.position)).repeat_interleave(size * size, dim=0)
    # A direction of 0 along an axis gives infinities of the right signs.
    low, high = ((side * half_extent - origin) / direction for side in (-1.0, 1.0))
    near = torch.minimum(low, high).amax(dim=1).clamp(min=0)
    far = torch.maximum(low, high).amin(dim=1)
    return Rays(origin, direction, near, torch.maximum(near, far))


def on_film(points: Float[Tensor, "N 3"], cameras: CameraBatch, view: int, size: int) -> Float[Tensor, "N 2"]:
    """Where points in front of one of the cameras lie on its film: x to the right, y downwards, in pixels."""
    right, up, back = (torch.from_numpy(axis[view]) for axis in cameras.basis())
    offset = points - torch.from_numpy(np.array(cameras.position[view]))
    depth = -(offset @ back)
    scale = 0.5 * size / (depth * float(np.tan(np.radians(cameras.fov_deg[view]) / 2)))
    return torch.stack([0.5 * size + offset @ right * scale, 0.5 * size - offset @ up * scale], dim=1)


def along(rays: Rays, samples: int, jitter: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Points (N, samples, 3), one in each of the equal pieces of every ray, and the pieces' lengths (N,).

    Args:
        jitter: (N, 1) in [0, 1): where in its piece a point lies, the same in all pieces of a ray; None: in the middle.
    """
    length = (rays.far - rays.near) / samples
    place = torch.arange(samples, dtype=length.dtype)[None] + (0.5 if jitter is None else jitter)
    distance = rays.near[:, None] + place * length[:, None]
    return rays.origin[:, None] + distance[..., None] * rays.direction[:, None], length


def ray_weights(sigma: Float[Tensor, "N S"], length: Float[Tensor, " N"]) -> Float[Tensor, "N S"]:
    """w_i of the formulas above: which share of a ray ends in each of its pieces. Gradients flow to `sigma`."""
    depth = sigma * length[:, None]
    before = torch.cumsum(depth, dim=1) - depth
    return torch.exp(-before) * -torch.expm1(-depth)
