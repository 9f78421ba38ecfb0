"""A picture autoencoder whose weights are written down, not learned: the coarse latent of a normal picture.

The encoder takes normals as colours on black, c = (n + 1) / 2 on covered pixels, and returns at an eighth of the size
    (mean of n m, 2 mean of m - 1),   m = clamp((c_r + c_g + c_b) / TAU, 0, 1),
which is what the coarse phase feeds to the UNet directly, so one UNet serves both phases. Every unit normal has
c_r + c_g + c_b >= (3 - sqrt 3) / 2 = 0.634, above TAU, so m is 1 on covered pixels and 0 on black; it errs on
partly covered ones only. The decoder inverts this up to the resolution.
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers import AutoencoderTiny

TAU = 0.6
CENTRE = (1, 1)
"""The middle of a 3x3 kernel."""


def build_vae() -> AutoencoderTiny:
    """The autoencoder; a few hundred weights, each a closed form."""
    vae = blank_vae(5)
    with torch.no_grad():
        _write_encoder(encoder_layers(vae))
        _write_decoder(decoder_convolutions(vae)[0])
    return vae


def blank_vae(channels: int) -> AutoencoderTiny:
    """An autoencoder that halves a picture three times, with `channels` on the way; weights are 0 but for the means."""
    vae = AutoencoderTiny(
        encoder_block_out_channels=(channels,) * 4,
        decoder_block_out_channels=(3, 3, 3, 3),
        num_encoder_blocks=(1, 0, 0, 0),
        num_decoder_blocks=(0, 0, 0, 0),
        latent_channels=4,
        scaling_factor=1.0,
    )
    row, column = CENTRE
    with torch.no_grad():
        for parameter in vae.parameters():
            parameter.zero_()
        _first, _relu_block, *halvings, _to_latent = encoder_layers(vae)
        for k in range(channels):
            for halving in halvings:
                # A stride-2 convolution padded by 1 sees rows 2i-1 .. 2i+1: the last two are the 2x2 block.
                halving.weight[k, k, 1:, 1:] = 0.25
        _first, *enlarging = decoder_convolutions(vae)
        for k in range(3):
            for convolution in enlarging:
                convolution.weight[k, k, row, column] = 1
    return vae.eval()


def encoder_layers(vae: AutoencoderTiny) -> list[Any]:
    """The encoder's layers, the one that reads the picture first; all but the second are convolutions with biases."""
    return list(vae.encoder.layers)


def decoder_convolutions(vae: AutoencoderTiny) -> list[Any]:
    """The decoder's convolutions, the one that reads the latent first."""
    return [layer for layer in vae.decoder.layers if isinstance(layer, torch.nn.Conv2d)]


def _write_encoder(layers: list[Any]) -> None:
    colours_and_ramps, to_latent = layers[0], layers[-1]
    row, column = CENTRE
    for k in range(3):
        colours_and_ramps.weight[k, k, row, column] = 1
        colours_and_ramps.weight[3:, k, row, column] = 1 / TAU
    colours_and_ramps.bias[4] = -1  # relu(s / TAU) - relu(s / TAU - 1) = clamp(s / TAU, 0, 1)
    for k in range(3):
        to_latent.weight[k, k, row, column] = 2
        to_latent.weight[k, 3, row, column], to_latent.weight[k, 4, row, column] = -1, 1
    to_latent.weight[3, 3, row, column], to_latent.weight[3, 4, row, column] = 2, -2
    to_latent.bias[3] = -1


def _write_decoder(first: Any) -> None:
    row, column = CENTRE
    for k in range(3):
        first.weight[k, k, row, column] = 0.5  # c = (n m + m) / 2 with m = (latent_3 + 1) / 2
        first.weight[k, 3, row, column] = 0.25
        first.bias[k] = 0.25
