"""On which side of the surface each site lies, evaluated again only where that may have changed.

An optimiser's step moves the part's sdf by little, and the parameters say by how much at most (`fields.change_bound`).
A site whose sdf was further from 0 than all that came since keeps its sign: one in twenty must be looked at.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.extraction.marching_tets import true_positions
from fd_mitsuba.fields.change_bound import ChangeBound
from fd_mitsuba.fields.index_spaces import Sites
from fd_mitsuba.fields.lattice_sites import SiteFeatures
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.fields.union import soft_union

_ROUNDING = 1e-5
"""Canonical units, a thousandth of a cell; single precision errs by less."""


class SiteSigns:
    """Signs at sites for one state of a field after another.

    Args:
        sdf_base: (A,) base sdf at the sites, inside positive, canonical units.
        initial_sdf: (A,) signed distance to the focal regions there.
        union_k, union_only_outside: see `soft_union`.
        depth: canonical units; None if nobody wants `deeper`.

    Attributes:
        inside: (A,) bool, whether the union is positive.
        deeper: (A,) bool, whether `sdf_part` exceeds `depth`.
    """

    def __init__(
        self, sdf_base: Tensor, initial_sdf: Tensor, union_k: float, union_only_outside: bool, depth: float | None
    ) -> None:
        self._base, self._initial, self._depth = sdf_base, initial_sdf, depth
        self._union_k, self._only_outside = union_k, union_only_outside
        self.inside, self.deeper = (torch.zeros(len(sdf_base), dtype=torch.bool) for _ in range(2))
        self._bound, self._spent = ChangeBound(), 0.0
        self._keeps_until = torch.full((len(sdf_base),), -torch.inf, dtype=torch.float64)

    @torch.no_grad()
    def update(self, field: PartField, features: SiteFeatures) -> Sites:
        """Looks at the sites whose signs may have changed since the last call, and returns which (N,), ascending.

        The soft union never changes by more than the part. With `union_only_outside` it leaps where the part's own
        sign changes, so that counts there, too.

        Args:
            field: any state of a part; each call may bring another.
            features: its `site_features`.
        """
        moved = self._bound.since_last(field)
        if moved < torch.inf:
            self._spent += moved
        else:  # also what is no number
            self._keeps_until.fill_(-torch.inf)
        due = Sites(true_positions(self._keeps_until <= self._spent))
        part = field.site_sdf(features, due, self._initial.index_select(0, due))
        union = soft_union(self._base.index_select(0, due), part, self._union_k, self._only_outside)
        away = union.abs()
        if self._only_outside:
            away = torch.minimum(away, part.abs())
        if self._depth is not None:
            away = torch.minimum(away, (part - self._depth).abs())
            self.deeper[due] = part > self._depth
        self.inside[due] = union > 0
        self._keeps_until[due] = away.double() - _ROUNDING + self._spent
        return due
