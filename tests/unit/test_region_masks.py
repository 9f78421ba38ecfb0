"""Which of several parts a pixel is told about."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from fd_mitsuba.training.region_masks import shown_first


def test_what_a_pixel_shows_counts_before_the_region_before_it() -> None:
    """Four pixels: the crown before the wings' region, a wing, base within the wings' region, and nothing."""
    masks = {
        "crown": torch.tensor([0.0, 0.0, 0.0, 0.0]).reshape(1, 1, 2, 2),
        "wings": torch.tensor([1.0, 0.5, 1.0, 0.0]).reshape(1, 1, 2, 2),
    }
    seen = SimpleNamespace(
        alpha=torch.ones(1, 1, 2, 2),
        part_mask=torch.tensor([1.0, 0.3, 0.0, 0.0]).reshape(1, 1, 2, 2),
        pixel=torch.tensor([0, 1, 2]),
        part=torch.tensor([0, 1, 0]),  # the third shows the base, where the field shades that too
    )
    found = shown_first(masks, seen)
    assert found["crown"].flatten().tolist() == [1, 0, 0, 0]
    assert found["wings"].flatten().tolist() == [0, 1, 1, 0]
    finer = SimpleNamespace(
        alpha=torch.ones(1, 1, 4, 4),
        part_mask=torch.ones(1, 1, 4, 4),
        pixel=torch.tensor([0, 1]),  # half of the first pixel of masks of half the size
        part=torch.tensor([0, 0]),
    )
    found = shown_first(masks, finer)
    assert found["crown"].flatten().tolist() == [0.5, 0, 0, 0] and found["wings"].flatten().tolist() == [0.5, 0.5, 1, 0]
    assert shown_first({"part": masks["wings"]}, seen)["part"] is masks["wings"]
