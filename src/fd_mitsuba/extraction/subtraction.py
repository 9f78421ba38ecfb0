"""The surface of the base without the part, by the extraction of `extraction.surface` turned inside out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torch import Tensor

from fd_mitsuba.extraction.surface import Samples, SurfaceExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.index_spaces import GridVertices
from fd_mitsuba.fields.part_sdf import PartField


class SubtractionExtractor(SurfaceExtractor):
    """Turns a part's field into the surface of `soft_subtract(sdf_base, sdf_part, union_k)`.

    What is left of the base ends where the union of its outside and the part begins:

        soft_subtract(sdf_base, sdf_part, k) = -soft_union(-sdf_base, sdf_part, k)

    so this is `SurfaceExtractor` on the base's outside, with every face turned round. `part_weight` and `face_is_part`
    mark the cut; `static_faces` and `static_vertices` are the base's own as before. The base alone differs from what
    `SurfaceExtractor` makes of it in how the tetrahedra's quadrangles are split: compare surfaces of one kind only.

    Args:
        sdf_base: (count,) of the base itself, inside positive. The attribute `sdf_base` holds that of its outside.
        Others: see `SurfaceExtractor`.
    """

    def __init__(self, grid: TetGrid, sdf_base: Tensor, *others: Any, **named: Any) -> None:
        super().__init__(grid, -sdf_base, *others, **named)

    def __call__(self, field: PartField, samples: Samples | None = None) -> UnionSurface:
        """The remaining base's surface, counter-clockwise seen from outside; see `SurfaceExtractor.__call__`."""
        return _turned(super().__call__(field, samples))

    def extract_plain(self, field: PartField, samples: GridVertices | None = None) -> UnionSurface:
        """The same surface, vertices in another order, from the field at all vertices and all tetrahedra."""
        return _turned(super().extract_plain(field, samples))


def _turned(surface: UnionSurface) -> UnionSurface:
    return replace(surface, faces=surface.faces.flip(1))
