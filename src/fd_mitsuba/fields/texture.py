"""The part's material as a function of position: base colour, roughness, metallic, and a bend of the shading normal.

    (kd, krm, kn) = squash(start + mlp(hash_grid(x)))

Paper: "Dual-path Physically Based Rendering" and supplement "PBR Material" (a hash grid and one hidden layer of 32).
Deviates: kn has two degrees of freedom, the slopes of the normal, since its length says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fd_mitsuba.config.sections import TextureConfig
from fd_mitsuba.conventions import GRID_HALF_EXTENT, TEXTURE_CHANNELS
from fd_mitsuba.fields.free_points import features_at
from fd_mitsuba.fields.hash_grid import HashGrid
from fd_mitsuba.fields.mlp import ColumnMlp
from fd_mitsuba.scene.bsdf_reading import PlainMaterial

_MARGIN = 0.03
"""The start keeps this share of a range from its ends, where the squashing curve is too flat to leave."""


@dataclass(frozen=True)
class TextureValues:
    """A material at N points."""

    base_color: Float[Tensor, "N 3"]
    """(N, 3) linear, in the configured range."""
    roughness: Float[Tensor, "N 1"]
    """(N, 1) as `principled` means it: its microfacet alpha is the square."""
    metallic: Float[Tensor, "N 1"]
    """(N, 1)."""
    normal: Float[Tensor, "N 3"]
    """(N, 3) unit normal in the tangent frame of the shading normal, which is (0, 0, 1)."""

    def style(self) -> Float[Tensor, "N 5"]:
        """(N, 5) kd and krm: what style consistency compares."""
        return torch.cat([self.base_color, self.roughness, self.metallic], dim=1)


class TextureField(nn.Module):
    """The network of the part's material. Its `state_dict` holds the learned weights and is all a checkpoint needs.

    It may be moved to a card: points go there, and what it says comes back to where they are, gradients the other way.

    Args:
        config: sizes of the network and the ranges of what it says.
        seed: decides the initial weights.
        start: the material everywhere before the first step: exact where it lies within its range by 3 % of the
            range's width, else moved there. The normal starts as exactly (0, 0, 1).
        learned: the channels that are learned. The others are exactly `start`, whatever the ranges, without gradient.
        half_extent: the field lives in [-half_extent, half_extent]^3 of the canonical frame.
    """

    _low: Tensor
    _span: Tensor
    _offset: Tensor
    _fixed: Tensor

    def __init__(
        self,
        config: TextureConfig | None = None,
        seed: int = 0,
        start: PlainMaterial | None = None,
        learned: Collection[str] = TEXTURE_CHANNELS,
        half_extent: float = GRID_HALF_EXTENT,
    ) -> None:
        super().__init__()
        config, start = config or TextureConfig(), start or PlainMaterial()
        unknown = set(learned) - set(TEXTURE_CHANNELS)
        if unknown:
            raise ValueError(f"unknown channels {sorted(unknown)}; a texture has {TEXTURE_CHANNELS}")
        self.learned = tuple(channel for channel in TEXTURE_CHANNELS if channel in learned)
        self.grid = HashGrid(
            config.levels,
            config.features,
            config.base_resolution,
            config.finest_resolution,
            config.log2_table,
            seed,
            half_extent,
        )
        self.mlp = ColumnMlp(self.grid.width, config.hidden, 7, seed + 1)
        ranges = [config.base_color_range] * 3 + [config.roughness_range, config.metallic_range]
        fixed = [*start.base_color, start.roughness, start.metallic]
        self._constant("_low", [low for low, _ in ranges])
        self._constant("_span", [high - low for low, high in ranges])
        self._constant("_offset", [_logit(*pair) for pair in zip(fixed, ranges, strict=True)])
        self._constant("_fixed", fixed)
        self._steepest = math.tan(math.radians(config.max_tilt_deg))

    def forward(self, points: Float[Tensor, "N 3"]) -> TextureValues:
        """The material at canonical points (N, 3). Gradients flow to the weights, not to the points."""
        rows = self.mlp(features_at(self.grid, points))
        dtype = rows.dtype
        scalars = self._low.to(dtype) + self._span.to(dtype) * torch.sigmoid(rows[:5] + self._offset.to(dtype))
        constant = self._fixed.to(dtype).expand(5, len(points))
        color, roughness, metallic = (
            (scalars if channel in self.learned else constant)[where].t()
            for channel, where in (("base_color", slice(3)), ("roughness", slice(3, 4)), ("metallic", slice(4, 5)))
        )
        values = color, roughness, metallic, self._normal(rows[5:])
        return TextureValues(*(value.to(points.device) for value in values))

    def _constant(self, name: str, column: list[float]) -> None:
        """A column that goes with the field to a card, and into no checkpoint."""
        self.register_buffer(name, torch.tensor(column)[:, None], persistent=False)

    def _normal(self, rows: Tensor) -> Tensor:
        if "normal" not in self.learned:
            return rows.new_tensor([0.0, 0.0, 1.0]).expand(rows.shape[1], 3)
        # Any slope is shortened to less than the steepest one, smoothly and keeping its direction.
        slope = self._steepest * rows / torch.sqrt(1 + rows.square().sum(dim=0, keepdim=True))
        normal = torch.cat([slope, torch.ones_like(slope[:1])]).t()
        return normal / torch.linalg.vector_norm(normal, dim=1, keepdim=True)


def _logit(value: float, limits: tuple[float, float]) -> float:
    """Where the squashing curve has `value`, kept off the ends of its range; 0 for a range without width."""
    low, high = limits
    if high <= low:
        return 0.0
    share = min(max((value - low) / (high - low), _MARGIN), 1 - _MARGIN)
    return math.log(share / (1 - share))
