"""Smooth vertex normals of a mesh, and their derivative, at the cost of the faces that change.

torch and SciPy, not Dr.Jit, whose atomic additions take several times as long and have no fixed order. Vectors are
columns here, all x first: sums at vertices are then sums of single numbers, one after another, which neither sort nor
start a loop for each of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.sparse import csc_array
from torch import Tensor

_SMALLEST = 1e-36
"""Squared length of a sum of face normals below which a vertex counts as having no area."""


def vertex_normals(vertices: Tensor, faces: Tensor, fixed_sums: Tensor | None = None) -> Tensor:
    """Unit normals (V, 3): the sum of the surrounding faces' normals, weighted by area; zero at vertices without area.

    Area, not angle: marching tetrahedra leave slivers, whose angles have derivatives without bound, while the
    area-weighted sum is a polynomial of the positions.

    Args:
        vertices: (V, 3) float32.
        faces: (F, 3) int64.
        fixed_sums: (K, 3), K <= V, `area_sums` of further faces, which belong to the first K vertices and are constant.

    Gradients flow to `vertices`, once; none to a vertex without area.
    """
    return _Normals.apply(vertices, faces, fixed_sums)


def area_sums(vertices: Tensor, faces: Tensor) -> Tensor:
    """The sums (V, 3) of face normals around each vertex, each as long as twice the face's area. No gradients."""
    return _rows(_face_sums(len(vertices), faces, _cross(*_edges(vertices, _columns(faces)))))


class _Normals(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor, fixed_sums: Tensor | None) -> Tensor:
        corners = _columns(faces)
        to_b, to_c = _edges(vertices, corners)
        total = _face_sums(len(vertices), faces, _cross(to_b, to_c))
        if fixed_sums is not None:
            total[:, : len(fixed_sums)] += _columns(fixed_sums)
        squared = _dot(total, total)
        inverse = squared.clamp(min=_SMALLEST).rsqrt_()
        normals = total.mul_(inverse)
        if ctx.needs_input_grad[0]:
            inverse[squared < _SMALLEST] = 0
            ctx.save_for_backward(corners, to_b, to_c, normals, inverse)
        return _rows(normals)

    # What `once_differentiable` makes of it takes no keywords, which torch's own signature has.
    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, gradient: Tensor
    ) -> tuple[Tensor | None, ...]:
        corners, to_b, to_c, normals, inverse = ctx.saved_tensors
        of_total = _columns(gradient)
        of_total = of_total.sub_(_dot(of_total, normals) * normals).mul_(inverse)
        of_normal = of_total.index_select(1, corners[0])
        of_normal += of_total.index_select(1, corners[1])
        of_normal += of_total.index_select(1, corners[2])
        of_b, of_c = _cross(to_c, of_normal), _cross(of_normal, to_b)
        result = torch.zeros_like(of_total)
        for axis, total in enumerate(result):
            total.scatter_add_(0, corners[0], (of_b[axis] + of_c[axis]).neg_())
            total.scatter_add_(0, corners[1], of_b[axis])
            total.scatter_add_(0, corners[2], of_c[axis])
        return _rows(result), None, None


def _columns(rows: Tensor) -> Tensor:
    """(N, 3) as a new contiguous (3, N); NumPy copies this shape several times as fast as torch."""
    return torch.from_numpy(rows.detach().numpy().T.copy())


def _rows(columns: Tensor) -> Tensor:
    """(3, N) as a new contiguous (N, 3)."""
    return torch.from_numpy(columns.numpy().T.copy())


def _edges(vertices: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """b - a and c - a, each (3, F), of faces `corners` (3, F) with the corners a, b, c."""
    positions = _columns(vertices)
    a, b, c = (positions.index_select(1, corner) for corner in corners)
    return b.sub_(a), c.sub_(a)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross products of vectors (3, F)."""
    result = torch.empty_like(a)
    for axis, out in enumerate(result):
        following, last = (axis + 1) % 3, (axis + 2) % 3
        torch.mul(a[following], b[last], out=out)
        out.addcmul_(a[last], b[following], value=-1)
    return result


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """The dot products (N,) of vectors (3, N)."""
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def _face_sums(count: int, faces: Tensor, values: Tensor) -> Tensor:
    """The sums (3, count) at vertices of the `values` (3, F) of the faces (F, 3) around them, face after face."""
    corners = faces.numpy().reshape(-1).astype(np.int32)
    starts = np.arange(0, len(corners) + 1, 3, dtype=np.int32)
    # Column f of the matrix has a one in the rows of face f's corners.
    matrix = csc_array((np.ones(len(corners), values.numpy().dtype), corners, starts), shape=(count, len(faces)))
    return torch.from_numpy(np.stack([matrix @ row for row in values.numpy()]))
