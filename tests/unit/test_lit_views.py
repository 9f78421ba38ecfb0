"""Pictures for people: a pixel is a mean over finer ones, because fields are asked once for each of those."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fd_mitsuba.viewing.lit_views import lit_ring, ring_cameras


class Board:
    """Shows pixels of light 0 and 1/2 in turn, whatever the size, as a field does that flickers from pixel to pixel."""

    def __init__(self) -> None:
        self.traced: list[tuple[int, int]] = []

    def trace(self, cameras, seed: int, size: int, spp: int) -> SimpleNamespace:
        self.traced.append((size, spp))
        return SimpleNamespace(alpha=torch.ones(len(cameras), 1, size, size))


def checkers(gbuffer: SimpleNamespace, seed: int) -> torch.Tensor:
    side = torch.arange(gbuffer.alpha.shape[-1])
    return ((side[:, None] + side) % 2 / 2).expand(len(gbuffer.alpha), 3, -1, -1)


@pytest.mark.parametrize(("spp", "traced"), [(16, (8, 16)), (32, (16, 8)), (64, (16, 16))])
def test_pixels_are_means_where_samples_are_many(spp: int, traced: tuple[int, int]) -> None:
    board = Board()
    frames = lit_ring(board, checkers, ring_cameras(6, np.zeros(3)), 1.0, 8, spp)  # type: ignore[arg-type]
    assert frames.shape == (6, 8, 8, 3) and board.traced == [traced] * 2
    # sRGB by hand: 255 (1.055 x^(1/2.4) - 0.055) is 187.5 for x = 1/2 and 137.0 for 1/4.
    assert set(np.unique(frames)) == ({0, 188} if traced[0] == 8 else {137})
