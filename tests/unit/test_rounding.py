"""Parts that are rounded off in pictures: what changes, what stays, and that views do not see each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from fd_mitsuba.prior.pictures import rounding
from fd_mitsuba.prior.pictures.fine_corpus import make_wide_pairs


@pytest.fixture(scope="module")
def pictures() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    pairs = [pair for seed in (1, 2) for pair in make_wide_pairs("bear", ["top hat", "backpack"], seed)]
    base, edited = (
        torch.from_numpy(np.stack([getattr(pair, name) for pair in pairs])) / 127 for name in ("base", "edited")
    )
    changed = torch.from_numpy(np.stack([pair.changed() for pair in pairs])).float()[:, None]
    return base, edited, changed


def _rounded(pictures: tuple[torch.Tensor, ...], seed: int = 0) -> torch.Tensor:
    return rounding.rounded(*pictures, torch.Generator().manual_seed(seed))


def test_far_from_the_part_nothing_changes(pictures: tuple[torch.Tensor, ...]) -> None:
    base, _, changed = pictures
    far = ndimage.distance_transform_edt(1 - changed.numpy(), sampling=(1e3, 1e3, 1, 1)) > 3 * rounding.RADII[1] + 2
    away = (_rounded(pictures) - base).abs().amax(1, keepdim=True)
    assert far.any() and float(away[torch.from_numpy(far)].max()) < 1e-6


def test_the_part_is_there_with_unit_normals_and_other_outlines(pictures: tuple[torch.Tensor, ...]) -> None:
    base, edited, changed = pictures
    made = _rounded(pictures)
    deep = torch.from_numpy(ndimage.binary_erosion(changed.numpy()[:, 0], np.ones((1, 5, 5))))[:, None]
    shown = (made - base).abs().amax(1, keepdim=True) > 0.1
    assert float(shown[deep].float().mean()) > 0.8
    normals = made[:, :3].norm(dim=1)[deep[:, 0]]
    assert float((normals - 1).abs().median()) < 0.05
    assert 0.02 < float((made - edited).abs().mean(dim=1, keepdim=True)[changed > 0].mean()) < 0.6


def test_the_same_generator_gives_the_same_and_another_one_not(pictures: tuple[torch.Tensor, ...]) -> None:
    assert torch.equal(_rounded(pictures), _rounded(pictures))
    assert not torch.equal(_rounded(pictures), _rounded(pictures, seed=1))


def test_blur_is_the_gaussian_one_of_each_view() -> None:
    values = torch.rand(3, 2, 16, 16, generator=torch.Generator().manual_seed(0))
    sigma = torch.tensor([0.5, 1.0, 2.0])[:, None, None, None]
    ours = rounding._softened(values, sigma, 6)
    for view, width in zip(range(3), (0.5, 1.0, 2.0), strict=True):
        theirs = ndimage.gaussian_filter(values[view].numpy(), (0, width, width), mode="constant", radius=6)
        assert np.abs(ours[view].numpy() - theirs).max() < 1e-5


def test_views_are_cut_out_of_mosaics_and_put_back() -> None:
    mosaics = torch.arange(2 * 3 * 8 * 8).float().reshape(2, 3, 8, 8)
    views = rounding._views(mosaics)
    assert torch.equal(views[1], mosaics[0, :, :4, 4:]) and torch.equal(views[6], mosaics[1, :, 4:, :4])
    assert torch.equal(rounding._mosaics(views), mosaics)
