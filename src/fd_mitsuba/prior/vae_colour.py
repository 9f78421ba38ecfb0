"""A colour picture's autoencoder whose weights are written down, not learned: area means of 8 x 8 pixels.

The latents are those of `guidance.colour_latents`; the decoder writes their first three channels back, enlarged.
"""

from __future__ import annotations

import torch
from diffusers import AutoencoderTiny

from fd_mitsuba.guidance.colour_latents import LUMA

_CENTRE = (1, 1)


def build_colour_vae() -> AutoencoderTiny:
    """The autoencoder; it takes and gives pictures 2 c - 1, as every Stable Diffusion VAE."""
    vae = AutoencoderTiny(
        encoder_block_out_channels=(3, 3, 3, 3),
        decoder_block_out_channels=(3, 3, 3, 3),
        num_encoder_blocks=(1, 0, 0, 0),
        num_decoder_blocks=(0, 0, 0, 0),
        latent_channels=4,
        scaling_factor=1.0,
    )
    with torch.no_grad():
        for parameter in vae.parameters():
            parameter.zero_()
        _write_encoder(vae.encoder.layers)
        _write_decoder(vae.decoder.layers)
    return vae.eval()


def _write_encoder(layers: torch.nn.Sequential) -> None:
    first, _relu_block, *halvings, to_latent = layers
    row, column = _CENTRE
    for k in range(3):
        first.weight[k, k, row, column] = 1  # the encoder itself turns 2 c - 1 back to c
        for halving in halvings:
            # A stride-2 convolution padded by 1 sees rows 2i-1 .. 2i+1: the last two are the 2x2 block.
            halving.weight[k, k, 1:, 1:] = 0.25
        to_latent.weight[k, k, row, column] = 2
        to_latent.weight[3, k, row, column] = 2 * LUMA[k]
    to_latent.bias.fill_(-1)


def _write_decoder(layers: torch.nn.Sequential) -> None:
    first, *rest = (layer for layer in layers if isinstance(layer, torch.nn.Conv2d))
    row, column = _CENTRE
    for k in range(3):
        first.weight[k, k, row, column], first.bias[k] = 0.5, 0.5
        for convolution in rest:
            convolution.weight[k, k, row, column] = 1
