"""What the surface of base and part is: its vertices on crossed edges, and which of it counts as the part's."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from fd_mitsuba.extraction.marching_tets import crossing_fraction


@dataclass(frozen=True)
class UnionSurface:
    """A welded triangle mesh, counter-clockwise seen from outside; empty tensors where there is no surface.

    Attributes:
        vertices: (V, 3) float32, canonical; gradients flow to the part's field.
        faces: (F, 3) int64.
        part_weight: (V,) in [0, 1], 0 on the base and 1 on the part, `clamp(0.5 + (sdf_part - sdf_base) / (2 spacing))`
            at the vertex; gradients flow. Unlike a label per face it moves continuously with the seam.
        face_is_part: (F,) bool, whether the mean of a face's part_weight exceeds 0.5.
        sample_sdf: (S,) `sdf_part` at the samples that the caller asked for; gradients flow.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int64[Tensor, "F 3"]
    part_weight: Float[Tensor, " V"]
    face_is_part: Bool[Tensor, " F"]
    sample_sdf: Float[Tensor, " S"]


def vertices_on_edges(
    positions: Tensor, sdf: Tensor, part_minus_base: Tensor, ends: Tensor, spacing: float
) -> tuple[Tensor, Tensor]:
    """Surface vertices (E, 3) and their part_weight (E,) on edges `ends` (2, E) between the given vertices."""
    from_lower = sdf.detach().index_select(0, ends[0]) > sdf.detach().index_select(0, ends[1])
    inner = torch.where(from_lower, ends[0], ends[1])
    outer = torch.where(from_lower, ends[1], ends[0])
    fraction = crossing_fraction(sdf.index_select(0, inner), sdf.index_select(0, outer), spacing)
    start = positions.index_select(0, inner)
    vertices = start + fraction[:, None] * (positions.index_select(0, outer) - start)
    inner_lead, outer_lead = part_minus_base.index_select(0, inner), part_minus_base.index_select(0, outer)
    lead = inner_lead + fraction * (outer_lead - inner_lead)
    return vertices, (0.5 + lead / (2 * spacing)).clamp(0, 1)


def faces_of_part(part_weight: Tensor, faces: Tensor) -> Tensor:
    first, second, third = part_weight.detach().index_select(0, faces.view(-1)).view(-1, 3).unbind(dim=1)
    return first + second + third > 1.5
