"""DDIM against closed forms: a network that knows the answer, and one that says constants."""

from __future__ import annotations

import torch
from torch import Tensor

from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.ddim import sample, timesteps

ALPHA_BARS = torch.linspace(0.9995, 0.005, 1000)


def test_sampling_arrives_at_what_the_network_sees_and_keeps_what_is_held() -> None:
    generator = torch.Generator().manual_seed(0)
    target, known, noise = (torch.randn(2, 4, 8, 8, generator=generator) for _ in range(3))

    def noise_in(z_t: Tensor, now: Tensor) -> Tensor:
        level = ALPHA_BARS[now].view(-1, 1, 1, 1)
        return (z_t - level.sqrt() * target) / (1 - level).sqrt()

    assert torch.allclose(sample(noise_in, ALPHA_BARS, noise, 5), target, atol=1e-3)
    inside = torch.zeros(2, 1, 8, 8)
    inside[..., :4] = 1
    made = sample(noise_in, ALPHA_BARS, noise, 5, (inside, known))
    assert torch.equal(made[..., 4:], known[..., 4:])
    assert torch.allclose(made[..., :4], target[..., :4], atol=1e-3)
    assert timesteps(3, 1000) == [979, 500, 20] and timesteps(1, 1000) == [979]


def test_one_step_is_the_networks_first_estimate_with_both_scales() -> None:
    """Closed form: e_hat = plain + 2 (image - plain) + 3 (text - image), from constants."""
    noise = torch.randn(1, 4, 4, 4, generator=torch.Generator().manual_seed(1))
    values = {"text": 0.3, "image": 0.2, "plain": 0.1}
    coefficients = sds.cfg_coefficients_with_image(3.0, 2.0)

    def noise_in(z_t: Tensor, now: Tensor) -> Tensor:
        return sds.combine({name: torch.full_like(z_t, value) for name, value in values.items()}, coefficients)

    made = sample(noise_in, ALPHA_BARS, noise, 1)
    level = ALPHA_BARS[979]
    e_hat = 0.1 + 2 * (0.2 - 0.1) + 3 * (0.3 - 0.2)
    assert torch.allclose(made, (noise - (1 - level).sqrt() * e_hat) / level.sqrt(), atol=1e-5)
