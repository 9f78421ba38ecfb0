"""What a mesh must fulfil before Embree and Dr.Jit see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class CheckedMesh:
    """The mesh without its gradients; shares torch's memory where it can."""

    vertices: np.ndarray
    """(V, 3) float32, finite."""
    faces: np.ndarray
    """(F, 3) int64, all below V."""
    static_faces: int

    @property
    def static_vertices(self) -> int:
        """How many vertices at the head of the list the static faces reach."""
        return int(self.faces[: self.static_faces].max()) + 1 if self.static_faces else 0


def check_mesh(
    vertices: torch.Tensor, faces: torch.Tensor, part_weight: torch.Tensor, static_faces: int = 0
) -> CheckedMesh:
    """The mesh, if nothing in it can harm the ray tracer: Embree and Dr.Jit crash on bad indices and swallow NaN.

    Raises:
        ValueError: wrong shape or kind of number, an index out of range (named), values that are not finite (counted).
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not vertices.is_floating_point():
        raise ValueError(f"vertices: expected a float tensor (V, 3), got {vertices.dtype} {tuple(vertices.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.is_floating_point():
        raise ValueError(f"faces: expected an integer tensor (F, 3), got {faces.dtype} {tuple(faces.shape)}")
    if part_weight.shape != vertices.shape[:1] or not part_weight.is_floating_point():
        raise ValueError(f"part_weight: expected float (V,) = ({len(vertices)},), got {tuple(part_weight.shape)}")
    if not 0 <= static_faces <= len(faces):
        raise ValueError(f"static_faces = {static_faces}: must lie between 0 and the {len(faces)} faces")
    # numpy, not torch: these passes are short, and torch's would wait for all its threads each time.
    positions = vertices.detach().to(torch.float32).contiguous().numpy()
    triangles = faces.detach().to(torch.int64).contiguous().numpy()
    for name, values in (("vertices", positions), ("part_weight", part_weight.detach().to(torch.float32).numpy())):
        bad = int((~np.isfinite(values)).sum())
        if bad:
            raise ValueError(f"{name}: {bad} values are not finite")
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(positions)):
        wrong = int(np.flatnonzero(((triangles < 0) | (triangles >= len(positions))).any(axis=1))[0])
        raise ValueError(f"faces: face {wrong} names vertex {triangles[wrong].tolist()} of {len(positions)}")
    return CheckedMesh(positions, triangles, static_faces)
