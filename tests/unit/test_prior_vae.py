from __future__ import annotations

import pytest
import torch
from torch.nn.functional import avg_pool2d, interpolate

from fd_mitsuba.prior.training.vae import TAU, build_vae


def hard_edged(cell: int, count: int = 2, size: int = 64, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals (N, 3, S, S) and a mask (N, 1, S, S) of zeros and ones, constant in cells of `cell` pixels."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, size // cell, size // cell, generator=generator)
    normal = normal / normal.norm(dim=1, keepdim=True)
    mask = (torch.rand(count, 1, size // cell, size // cell, generator=generator) < 0.6).float()
    return interpolate(normal, scale_factor=cell), interpolate(mask, scale_factor=cell)


@pytest.mark.parametrize("cell", [1, 2, 4, 8])
@torch.no_grad()
def test_encoder_averages_normals_and_mask(cell: int) -> None:
    normal, mask = hard_edged(cell)
    colours = (normal + 1) / 2 * mask
    latents = build_vae().encode(2 * colours - 1).latents
    expected = torch.cat([avg_pool2d(normal * mask, 8), 2 * avg_pool2d(mask, 8) - 1], dim=1)
    assert latents.shape == expected.shape == (2, 4, 8, 8)
    assert torch.allclose(latents, expected, atol=1e-5)


def test_every_unit_normal_is_brighter_than_the_threshold() -> None:
    """The darkest covered colour belongs to the normal (-1, -1, -1) / sqrt 3."""
    darkest = 3 * (1 - 3**-0.5) / 2
    assert darkest > TAU
    normal = torch.full((1, 3, 8, 8), -(3**-0.5))
    with torch.no_grad():
        latent = build_vae().encode(normal).latents
    assert torch.allclose(latent.flatten(), torch.tensor([-(3**-0.5)] * 3 + [1.0]), atol=1e-5)


@torch.no_grad()
def test_decoder_inverts_the_encoder_up_to_the_resolution() -> None:
    normal, mask = hard_edged(8, seed=1)
    picture = (normal + 1) * mask - 1
    vae = build_vae()
    decoded = vae.decode(vae.encode(picture).latents).sample
    # AutoencoderTiny squeezes latents by 3 tanh(z / 3), which changes a value of 1 by 0.036.
    assert decoded.shape == picture.shape and (decoded - picture).abs().max() < 0.06


def test_gradients_reach_the_picture() -> None:
    normal, mask = hard_edged(1, count=1)
    picture = ((normal + 1) * mask - 1).requires_grad_()
    build_vae().encode(picture).latents[:, :3].sum().backward()
    assert picture.grad is not None and torch.allclose(picture.grad[mask.expand_as(picture) > 0], torch.tensor(1 / 64))
