from __future__ import annotations

import torch
from torch.nn.functional import avg_pool2d, interpolate

from fd_mitsuba.guidance.colour_latents import colour_latents, shine
from fd_mitsuba.prior.training.vae_colour import build_colour_vae


def picture(size: int = 64, seed: int = 0) -> torch.Tensor:
    """sRGB in [0, 1], half of it black."""
    generator = torch.Generator().manual_seed(seed)
    colour = torch.rand(2, 3, size, size, generator=generator)
    return colour * (torch.rand(2, 1, size, size, generator=generator) < 0.5)


@torch.no_grad()
def test_encoder_averages_colours_and_knows_no_shine() -> None:
    colour = picture()
    latents = build_colour_vae().encode(2 * colour - 1).latents
    means = avg_pool2d(colour, 8)
    dull = torch.zeros_like(means[:, :1])
    torch.testing.assert_close(latents, 2 * torch.cat([means, dull], 1) - 1, atol=1e-5, rtol=0)
    shown = torch.cat([colour, torch.zeros_like(colour[:, :1])], 1)
    torch.testing.assert_close(colour_latents(shown, 8), latents, atol=1e-5, rtol=0)
    for size in (8, 16, 32):  # a picture of another size has the same means
        torch.testing.assert_close(colour_latents(avg_pool2d(shown, 64 // size), 8), latents, atol=1e-5, rtol=0)


def test_nothing_but_metal_shines_more_than_a_fifth() -> None:
    assert shine(torch.tensor(0.0), torch.tensor(1.0)) == 1 and shine(torch.tensor(1.0), torch.tensor(0.0)) == 0
    assert shine(torch.rand(50), torch.zeros(50)).max() <= 0.2


@torch.no_grad()
def test_black_stays_black_and_white_white() -> None:
    vae = build_colour_vae()
    for value in (0.0, 1.0):
        flat = torch.full((1, 3, 64, 64), value)
        assert torch.allclose(vae.encode(2 * flat - 1).latents[:, :3], torch.tensor(2 * value - 1), atol=1e-5)


@torch.no_grad()
def test_decoder_inverts_the_encoder_up_to_the_resolution() -> None:
    colour = interpolate(picture(8), scale_factor=8)
    vae = build_colour_vae()
    decoded = vae.decode(vae.encode(2 * colour - 1).latents).sample
    # AutoencoderTiny squeezes latents by 3 tanh(z / 3), which changes a value of 1 by 0.036.
    assert (decoded - (2 * colour - 1)).abs().max() < 0.06


def test_gradients_reach_the_picture() -> None:
    colour = picture().requires_grad_()
    build_colour_vae().encode(2 * colour - 1).latents[:, 0].sum().backward()
    # Where the picture is black the encoder's ReLU sits at its kink and may pass nothing.
    lit = colour.detach()[:, 0] > 0
    torch.testing.assert_close(colour.grad[:, 0][lit], torch.full((int(lit.sum()),), 2 / 64))
    assert (colour.grad[:, 1:] == 0).all()
