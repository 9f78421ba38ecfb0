"""Random turns of the normals that a step's guidance sees, so that no single colour comes to mean a direction."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.conventions import NormalAugmentation


def random_turns(count: int, kind: NormalAugmentation, generator: torch.Generator) -> Tensor:
    """(count, 3, 3) float32 matrices for the normals of as many views, orthogonal.

    `rotation`: evenly distributed among all rotations (of unit quaternions); `rotation_flip`: after it, x is mirrored
    in every other view, by chance.
    """
    w, x, y, z = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    turns = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    if kind == "rotation_flip":
        flipped = torch.randint(2, (count,), generator=generator) > 0
        turns[flipped, 0] *= -1
    return turns


def turned(pictures: Tensor, turns: Tensor) -> Tensor:
    """Geometry pictures (B, 5, H, H) with their normals turned, view by view. Gradients flow."""
    normals = torch.einsum("bij,bjhw->bihw", turns.to(pictures), pictures[:, :3])
    return torch.cat([normals, pictures[:, 3:]], dim=1)
