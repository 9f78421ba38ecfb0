"""How far a part's sdf can have moved since its parameters changed, so that it is evaluated only where that matters."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fd_mitsuba.fields.part_sdf import PartField


class ChangeBound:
    """Bounds the change of `sdf_part`, whatever the point, between one call and the next.

    With rows W of the inner layer, outer weights w, and f the features, whose sizes the table's largest rows bound,

        sdf' - sdf = sum_j (w'_j - w_j) relu(W_j f) + w'_j (relu(W'_j f') - relu(W_j f)),
        |sdf' - sdf| <= sum_j |w'_j - w_j| (|W_j| |f|) + |w'_j| (|W'_j - W_j| |f| + |W'_j| |f' - f|).

    Interpolation is a weighted mean of rows, so that no feature changes by more than the largest change of a row.
    """

    def __init__(self) -> None:
        self._last: tuple[Tensor, ...] | None = None
        self._size = torch.zeros(0)

    @torch.no_grad()
    def since_last(self, field: PartField) -> float:
        """The bound in canonical units; infinite at the first call."""
        table, inner, outer = field.grid.table, field.mlp.weight_in, field.mlp.weight_out[0]
        last, size = self._last, self._size
        self._last, self._size = (table.clone(), inner.clone(), outer.clone()), field.grid.largest(table)
        if last is None:
            return math.inf
        old_table, old_inner, old_outer = last
        of_hidden = (inner - old_inner).abs() @ size + inner.abs() @ field.grid.largest(table - old_table)
        return float((outer - old_outer).abs() @ (old_inner.abs() @ size) + outer.abs() @ of_hidden)
