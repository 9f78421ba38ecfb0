"""Several parts' materials, each a field of its own: what one part is to look like says nothing of another.

In one field they share a network, and before its features tell places apart all parts turn what the largest is to be: a
crown beside a red cape turned red, and its colour's squashing curve was too flat there to leave. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fd_mitsuba.fields.texture import TextureField, TextureValues
from fd_mitsuba.scene.focal_region import FocalRegion, deepest_in


class TexturesApart(nn.Module):
    """A field for each part; a point belongs to the part whose regions it is deepest in, or nearest to.

    Args:
        fields: at least one, with the same learned channels.
        regions: of each part, canonical frame.
    """

    def __init__(self, fields: Sequence[TextureField], regions: Sequence[Sequence[FocalRegion]]) -> None:
        super().__init__()
        self.fields, self._regions = nn.ModuleList(fields), [tuple(some) for some in regions]
        self.learned = fields[0].learned

    def forward(self, points: Float[Tensor, "N 3"]) -> TextureValues:
        """As `TextureField.forward`."""
        owner = self.owner(points)
        rows = [torch.nonzero(owner == number).flatten() for number in range(len(self.fields))]
        found = [field(points[row]) for field, row in zip(self.fields, rows, strict=True)]
        order = torch.argsort(torch.cat(rows)).to(points.device)
        names = ("base_color", "roughness", "metallic", "normal")
        return TextureValues(*(torch.cat([getattr(one, name) for one in found])[order] for name in names))

    def owner(self, points: Tensor) -> Tensor:
        """(N,) int64: which part points (N, 3) belong to."""
        return torch.from_numpy(deepest_in(points.detach().double().cpu().numpy(), self._regions))
