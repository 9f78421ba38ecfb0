"""Which vertices of the grid a part may reach."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.index_spaces import GridVertices

DEFAULT_MARGIN = 0.15
"""How far beyond the focal regions the part may reach at most, canonical units: three of the focal loss' free bands."""


def active_vertices(grid: TetGrid, region_sdf: Float[Tensor, " count"], margin: float = DEFAULT_MARGIN) -> GridVertices:
    """The vertices (A,) int64, ascending, that the part may reach: inside a region or closer to one than `margin`.

    Args:
        grid: the grid.
        region_sdf: (count,) signed distance to the focal regions, inside positive, the largest over the regions.
        margin: canonical units.

    The grid's border is left out, so that every surface is closed within the grid.
    """
    index = (region_sdf > -margin).nonzero()[:, 0]
    return GridVertices(index[~grid.is_border(index)])
