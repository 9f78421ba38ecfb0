"""A colour picture's autoencoder whose weights are written down, not learned: area means of 8 x 8 pixels.

The latents are those of `guidance.colour_latents`, without any shine, which a picture does not say; the decoder writes
their first three channels back, enlarged.
"""

from __future__ import annotations

import torch
from diffusers import AutoencoderTiny

from fd_mitsuba.prior.training.vae import CENTRE, blank_vae, decoder_convolutions, encoder_layers


def build_colour_vae() -> AutoencoderTiny:
    """The autoencoder; it takes and gives pictures 2 c - 1, as every Stable Diffusion VAE."""
    vae = blank_vae(3)
    row, column = CENTRE
    first, *_, to_latent = encoder_layers(vae)
    from_latent = decoder_convolutions(vae)[0]
    with torch.no_grad():
        for k in range(3):
            first.weight[k, k, row, column] = 1  # the encoder itself turns 2 c - 1 back to c
            to_latent.weight[k, k, row, column] = 2
            from_latent.weight[k, k, row, column], from_latent.bias[k] = 0.5, 0.5
        to_latent.bias.fill_(-1)
    return vae
