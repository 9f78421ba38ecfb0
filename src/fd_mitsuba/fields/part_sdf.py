"""The editable part: a signed distance that starts as the focal regions, and offsets of the grid's vertices.

    sdf_part(x) = initial_sdf(x) + residual(x),   (residual, logits) = mlp(hash_grid(x))

Paper: "Geometry Editing" (sdf and offset of every tetrahedral vertex) and supplement "Geometry Learning" (network).
Deviates: the paper fits the network to the ellipsoids in 15000 iterations; here the closed form stays and the network
learns the difference, so the start is exact and free.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.conventions import GRID_HALF_EXTENT
from fd_mitsuba.fields.hash_grid import HashGrid
from fd_mitsuba.fields.index_spaces import GridVertices, Sites
from fd_mitsuba.fields.lattice_sites import LatticeSites, SiteFeatures
from fd_mitsuba.fields.mlp import ColumnMlp

_PIECE = 1024
"""Columns in every product of `site_sdf`, so that a site's value has the same bits whoever else is asked for."""


class PartValues(NamedTuple):
    """What the field says at N points."""

    sdf: Float[Tensor, " N"]
    """(N,) signed distance of the part, inside positive, canonical units."""
    offset: Float[Tensor, "N 3"]
    """(N, 3) in (-1, 1): multiples of the furthest allowed move along each axis, half a cell of the caller's grid."""


class PartField(nn.Module):
    """The network of the editable part. Its `state_dict` holds plain tensors and is all that a checkpoint needs.

    Args:
        settings: sizes of the hash grid and of the perceptron.
        seed: decides the initial parameters.
        half_extent: the field lives in [-half_extent, half_extent]^3 of the canonical frame.
    """

    def __init__(
        self, settings: FieldConfig | None = None, seed: int = 0, half_extent: float = GRID_HALF_EXTENT
    ) -> None:
        super().__init__()
        settings = settings or FieldConfig()
        self.offsets = settings.offsets
        self.grid = HashGrid(
            settings.levels,
            settings.features,
            settings.base_resolution,
            settings.finest_resolution,
            settings.log2_table,
            seed,
            half_extent,
        )
        self.mlp = ColumnMlp(self.grid.width, settings.hidden, 4, seed + 1)

    def evaluate(self, points: Float[Tensor, "N 3"], initial_sdf: Float[Tensor, " N"]) -> PartValues:
        """The field at any canonical points (N, 3), point by point; gradients flow to the parameters and the points.

        Args:
            points: (N, 3).
            initial_sdf: (N,) signed distance to the focal regions there, the largest over the regions.
        """
        return self._values(self.mlp(self.grid(points).t()), initial_sdf)

    def sites(self, axis: Tensor, index: GridVertices) -> LatticeSites:
        """Constants that make `index` (A,) of a cubic lattice with coordinates `axis` (n,) fast to evaluate."""
        return LatticeSites(self.grid, axis, index)

    def site_features(self, sites: LatticeSites) -> SiteFeatures:
        """The features at all sites, without gradients."""
        return sites.features(self.grid.table)

    @torch.no_grad()
    def site_sdf(self, features: SiteFeatures, chosen: Sites, initial_sdf: Tensor) -> Tensor:
        """`sdf_part` (S,) at some sites, without gradients; the arguments are those of `site_values`."""
        columns = pad(features.columns(chosen), (0, -len(chosen) % _PIECE))
        rows = torch.cat([self.mlp.first_output(piece) for piece in columns.split(_PIECE, dim=1)])
        return initial_sdf + rows[: len(chosen)]

    def site_values(
        self, sites: LatticeSites, features: SiteFeatures, chosen: Sites, initial_sdf: Tensor
    ) -> PartValues:
        """The field at some sites, with gradients to the parameters.

        Args:
            sites: the constants.
            features: what `site_features` returned for the present parameters.
            chosen: (S,) ascending unique positions in `sites.index`.
            initial_sdf: (S,) signed distance to the focal regions at the chosen sites.
        """
        columns = sites.select(self.grid.table, features, chosen)
        return self._values(self.mlp(columns), initial_sdf)

    def _values(self, rows: Tensor, initial_sdf: Tensor) -> PartValues:
        logits = rows[1:].t().contiguous()  # one point after another: callers pick points
        return PartValues(initial_sdf + rows[0], torch.tanh(logits) if self.offsets else torch.zeros_like(logits))
