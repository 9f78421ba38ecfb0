"""The refinement of Vox-E: attention grids, a graph cut between edit and object, and the merged grid.

1. Cross-attention maps of the edited grid's views, for the words of the edit and of the object.
2. Two scalars a voxel whose volume renderings match these maps (L1 where the object is seen, and a total variation).
3. A graph cut over the occupied voxels: seeds where the attention is sure, edges that cost less where features differ.
4. Edited voxels where the cut says edit, the base's elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool3d

from fd_mitsuba.baselines.voxels.graph_cut import cut_labels, lattice_edges
from fd_mitsuba.baselines.voxels.grid import VoxelGrid, interpolated
from fd_mitsuba.baselines.voxels.rendering import view_weights
from fd_mitsuba.baselines.voxels.surface import SURFACE_ALPHA
from fd_mitsuba.scene.views import CameraBatch

SURE_EDIT, LEAST_SEEDS, MOST_REST = 0.992, 300 / 160**3, 5000
"""Vox-E's: voxels of at least this share of the largest probability are seeds of the edit, 300 of its 160^3 at least;
of the object's, up to 5000 random ones."""
_ATTENTION_RATE = 0.03


@dataclass(frozen=True)
class CutSettings:
    """Attributes:
    cost, sigma: an edge costs `cost` exp(-|difference of features| / `sigma`). Vox-E has 5 and 0.1 for colours; normals
        differ by more between neighbours.
    seed: of the object's random seeds.
    """

    cost: float = 5.0
    sigma: float = 0.5
    seed: int = 0


def attention_grids(
    grid: VoxelGrid, maps: Tensor, cameras: CameraBatch, samples: int, steps: int, lambda_tv: float
) -> Tensor:
    """(C, R, R, R) values at a grid's vertices whose volume renderings match maps (N, C, S, S) of N views.

    Args:
        samples: pieces of a ray.
        steps: of Adam, over all pixels of all views.
        lambda_tv: weight of the mean absolute difference of neighbouring voxels.
    """
    size, channels = maps.shape[-1], maps.shape[1]
    points, pixel, weight = view_weights(grid, cameras, size, samples)
    wanted = maps.permute(0, 2, 3, 1).reshape(-1, channels)
    covered = torch.zeros(len(wanted)).index_add(0, pixel, weight)
    seen = covered > SURFACE_ALPHA
    # What a pixel shows of voxels that cover it by half is half of their value.
    wanted = wanted * covered[:, None]
    values = torch.full((channels, *grid.density.shape), float(maps.mean())).requires_grad_()
    optimiser = torch.optim.Adam([values], lr=_ATTENTION_RATE)
    for _ in range(steps):
        made = torch.zeros_like(wanted).index_add(
            0, pixel, (interpolated(values, points, grid.half_extent) * weight).t()
        )
        loss = (made - wanted)[seen].abs().mean() + lambda_tv * total_variation(values)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return values.detach()


def total_variation(values: Tensor) -> Tensor:
    """Sum over the three axes of the mean absolute difference of neighbours, of values (C, R, R, R)."""
    return sum((values.diff(dim=axis).abs().mean() for axis in (1, 2, 3)), torch.zeros(()))


def edit_voxels(grid: VoxelGrid, attention: Tensor, settings: CutSettings) -> Tensor:
    """(R, R, R) bool: the occupied voxels of the edited grid that belong to the edit.

    Args:
        attention: (2, R, R, R) of the edit and of the object.
    """
    density = grid.density.detach()
    occupied = (density > grid.raw_of_alpha(SURFACE_ALPHA)).numpy()
    flat = np.flatnonzero(occupied)
    labels = torch.zeros(density.numel(), dtype=torch.bool)
    if not len(flat):
        return labels.view(density.shape)
    own = attention.view(2, -1)[:, torch.from_numpy(flat)]
    # Voxels that few rays see overshoot: one of them would be the measure of all.
    probability = torch.softmax(own.clamp(0, 1), dim=0)[0].numpy()
    edit = np.flatnonzero(probability >= SURE_EDIT * probability.max())
    least = round(LEAST_SEEDS * density.numel())
    if len(edit) < least:
        edit = np.argsort(-probability, kind="stable")[:least]
    rest = np.setdiff1d(np.flatnonzero(probability < 0.5), edit)
    random = np.random.default_rng(settings.seed)
    rest = random.choice(rest, min(MOST_REST, len(rest)), replace=False)
    edges = lattice_edges(occupied)
    features = grid.features.detach().view(len(grid.features), -1)[:, torch.from_numpy(flat)]
    features = (features / features.norm(dim=0).clamp(min=1)).numpy()
    apart = np.linalg.norm(features[:, edges[:, 0]] - features[:, edges[:, 1]], axis=0)
    costs = settings.cost * np.exp(-apart / settings.sigma)
    labels[torch.from_numpy(flat)] = torch.from_numpy(cut_labels(edges, costs, len(flat), edit, rest))
    return labels.view(density.shape)


def merged(edited: VoxelGrid, base: VoxelGrid, edit: Tensor) -> VoxelGrid:
    """A grid with the edited values where `edit` (R, R, R) says so, and the base's elsewhere.

    A rim of one voxel around the edit that the base leaves empty comes with it: without it a surface would end at
    the middles of voxels.
    """
    solid = base.density.detach() > base.raw_of_alpha(SURFACE_ALPHA)
    rim = max_pool3d(edit[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
    taken = edit | (rim & ~solid)
    made = VoxelGrid(base.resolution, len(base.features), base.half_extent)
    with torch.no_grad():
        made.density.copy_(torch.where(taken, edited.density, base.density))
        made.features.copy_(torch.where(taken, edited.features, base.features))
    return made


def as_large(maps: Tensor, size: int) -> Tensor:
    """Maps (N, C, s, s) at another size, smooth."""
    return interpolate(maps, size=(size, size), mode="bilinear", align_corners=False)
