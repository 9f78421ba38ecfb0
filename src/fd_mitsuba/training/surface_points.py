"""Random points on surfaces, by area."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.render.appearance_scene import Triangles


def points_on(meshes: Iterable[Triangles], count: int, seed: int) -> Tensor:
    """Points (count, 3) float32, uniform by area over the meshes' faces."""
    corners = np.concatenate([np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)] for mesh in meshes])
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    random = np.random.default_rng(seed)
    chosen = random.choice(len(corners), size=count, p=area / area.sum())
    first, second = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - first, first * (1 - second), first * second], axis=1)
    return torch.from_numpy(np.einsum("ij,ijk->ik", weights, corners[chosen]).astype(np.float32))


def chosen_rows(count: int, size: int, seed: int) -> Tensor:
    """`size` row numbers below `count`, with repetition; all rows once if there are no more than that."""
    if count <= size:
        return torch.arange(count)
    return torch.randint(count, (size,), generator=torch.Generator().manual_seed(seed))
