"""Smooth vertex normals of a mesh, and their derivative, at the cost of the faces that change.

torch, not Dr.Jit: its sums over the faces around each vertex sort first and add afterwards, which takes half the time
of atomic additions and has a fixed order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
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
    with torch.no_grad():
        corners = _columns(faces)
        normal = _cross(*_edges(vertices, corners))
        return _sums(vertices, corners, (normal, normal, normal))


class _Normals(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor, fixed_sums: Tensor | None) -> Tensor:
        corners = _columns(faces)
        to_b, to_c = _edges(vertices, corners)
        normal = _cross(to_b, to_c)
        total = _sums(vertices, corners, (normal, normal, normal))
        if fixed_sums is not None:
            total[: len(fixed_sums)] += fixed_sums
        squared = torch.einsum("ni,ni->n", total, total)
        inverse = squared.clamp(min=_SMALLEST).rsqrt()
        normals = total * inverse[:, None]
        if ctx.needs_input_grad[0]:
            inverse[squared < _SMALLEST] = 0
            ctx.save_for_backward(corners, to_b, to_c, normals, inverse)
        return normals

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        corners, to_b, to_c, normals, inverse = ctx.saved_tensors
        radial = torch.einsum("ni,ni->n", gradient, normals)
        of_total = _columns((gradient - radial[:, None] * normals) * inverse[:, None])
        of_normal = of_total.index_select(1, corners[0])
        of_normal += of_total.index_select(1, corners[1])
        of_normal += of_total.index_select(1, corners[2])
        of_b, of_c = _cross(to_c, of_normal), _cross(of_normal, to_b)
        return _sums(gradient, corners, (-(of_b + of_c), of_b, of_c)), None, None


def _columns(rows: Tensor) -> Tensor:
    """(N, 3) as a contiguous (3, N); NumPy copies this shape several times as fast as torch."""
    return torch.from_numpy(np.ascontiguousarray(rows.detach().numpy().T))


def _edges(vertices: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """b - a and c - a, each (3, F), of faces `corners` (3, F) with the corners a, b, c."""
    positions = _columns(vertices)
    a, b, c = (positions.index_select(1, corner) for corner in corners)
    return b.sub_(a), c.sub_(a)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross products (F, 3) of vectors (3, F)."""
    result = a.new_empty(a.shape[1], 3)
    for axis in range(3):
        following, last = (axis + 1) % 3, (axis + 2) % 3
        out = result[:, axis]
        torch.mul(a[following], b[last], out=out)
        out.addcmul_(a[last], b[following], value=-1)
    return result


def _sums(like: Tensor, corners: Tensor, values: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """An array (V, 3) like the first, with the sums over the faces of `values` (F, 3) of each corner at its vertex."""
    total = torch.zeros(like.shape, dtype=like.dtype)
    for corner, value in zip(corners, values, strict=True):
        total.scatter_add_(0, corner[:, None].expand(-1, 3), value)
    return total
