"""The maths of score distillation against numbers worked out by hand."""

from __future__ import annotations

import math

import diffusers
import jaxtyping
import pytest
import torch

from fd_mitsuba.guidance import sds


def latents(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32).view(-1, 1, 1, 1)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sds", [0.75, 0.36]),
        ("uniform", [1, 1]),
        ("fantasia3d", [0.375, 0.288]),
        ("inverse", [4 / 3, 1 / 0.36]),
        ("ism", [3**0.5, 0.75]),
    ],
)
def test_weightings(name: str, expected: list[float]) -> None:
    assert sds.weight(name, torch.tensor([0.25, 0.64])).tolist() == pytest.approx(expected)


def test_unknown_weighting_is_refused() -> None:
    with pytest.raises(jaxtyping.TypeCheckError, match="weighting"):
        sds.weight("snr", torch.ones(1))


def test_noise_is_mixed_by_level() -> None:
    # sqrt(.64) * 2 + sqrt(.36) * -1 = 1; the second latent is all noise.
    mixed = sds.add_noise(latents(2, 7), latents(-1, 3), torch.tensor([0.64, 0.0]))
    assert mixed.flatten().tolist() == pytest.approx([1.0, 3.0])


def test_every_prediction_type_gives_back_the_noise() -> None:
    generator = torch.Generator().manual_seed(1)
    z, noise = torch.randn(2, 3, 4, 4, 4, generator=generator)
    abar = torch.tensor([0.9, 0.5, 0.02])
    z_t = sds.add_noise(z, noise, abar)
    a = abar.view(-1, 1, 1, 1)
    for kind, output in (("epsilon", noise), ("v_prediction", a.sqrt() * noise - (1 - a).sqrt() * z), ("sample", z)):
        torch.testing.assert_close(sds.noise_from_prediction(output, z_t, abar, kind), noise, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(sds.clean_estimate(z_t, noise, abar), z, rtol=1e-3, atol=1e-4)


def test_without_any_signal_the_clean_estimate_is_large_and_finite() -> None:
    assert sds.clean_estimate(latents(3), latents(1), torch.zeros(1)).item() == pytest.approx(2e6)


def test_one_scale_guidance() -> None:
    predictions = {"text": latents(3), "plain": latents(1)}
    combined = sds.combine(predictions, sds.cfg_coefficients(7.5))
    assert combined.item() == pytest.approx(1 + 7.5 * (3 - 1))


def test_two_scale_guidance() -> None:
    predictions = {"text": latents(5), "image": latents(2), "plain": latents(1)}
    combined = sds.combine(predictions, sds.cfg_coefficients_with_image(7.5, 1.5))
    assert combined.item() == pytest.approx(1 + 1.5 * (2 - 1) + 7.5 * (5 - 2))


def test_passes_that_do_not_count_are_left_out() -> None:
    assert sds.cfg_coefficients(1) == {"text": 1}
    assert sds.cfg_coefficients(0) == {"plain": 1}
    assert set(sds.cfg_coefficients_with_image(7.5, 1)) == {"text", "image"}
    assert sds.cfg_coefficients_with_image(1, 1) == {"text": 1}
    assert set(sds.cfg_coefficients_with_image(1.5, 1.5)) == {"text", "plain"}


def test_gradients() -> None:
    weights = torch.tensor([0.5, 2.0])
    assert sds.sds_gradient(latents(3, 1), latents(1, 2), weights).flatten().tolist() == [1.0, -2.0]
    assert sds.csd_gradient(latents(3, 1), latents(1, 2), weights).flatten().tolist() == [1.0, -2.0]
    assert sds.reconstruction_gradient(latents(4, 0), latents(2, 1), weights).flatten().tolist() == [1.0, -2.0]


def test_sds_of_a_linear_denoiser_in_closed_form() -> None:
    """With e_hat = a z_t + b the gradient is w ((a sqrt(abar)) z + (a sqrt(1 - abar) - 1) e + b)."""
    generator = torch.Generator().manual_seed(2)
    z, noise = torch.randn(2, 2, 4, 8, 8, generator=generator)
    abar, a, b = torch.tensor([0.8, 0.3]), 0.6, -0.2
    noise_hat = a * sds.add_noise(z, noise, abar) + b
    gradient = sds.sds_gradient(noise_hat, noise, sds.weight("sds", abar))
    for row, level in enumerate((0.8, 0.3)):
        kept, lost = math.sqrt(level), math.sqrt(1 - level)
        expected = (1 - level) * (a * kept * z[row] + (a * lost - 1) * noise[row] + b)
        torch.testing.assert_close(gradient[row], expected, rtol=1e-5, atol=1e-6)


def test_one_step_reconstruction_is_reweighted_sds() -> None:
    generator = torch.Generator().manual_seed(3)
    z, noise, noise_hat = torch.randn(3, 1, 4, 8, 8, generator=generator)
    abar = torch.tensor([0.4])
    z_hat = sds.clean_estimate(sds.add_noise(z, noise, abar), noise_hat, abar)
    got = sds.reconstruction_gradient(z, z_hat, torch.ones(1))
    expected = sds.sds_gradient(noise_hat, noise, torch.ones(1)) * math.sqrt(0.6 / 0.4)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


def test_ddim_step_keeps_the_line_from_latents_to_noise() -> None:
    generator = torch.Generator().manual_seed(4)
    z, noise = torch.randn(2, 1, 4, 8, 8, generator=generator)
    high, low = torch.tensor([0.2]), torch.tensor([0.7])
    stepped = sds.ddim_step(sds.add_noise(z, noise, high), noise, high, low)
    torch.testing.assert_close(stepped, sds.add_noise(z, noise, low), rtol=1e-4, atol=1e-5)


def test_v_at_zero_terminal_snr_says_the_clean_latents() -> None:
    """alpha_bar = 0 at the last timestep (diffusers' `rescale_betas_zero_snr`): z_t is all noise, and z = -v."""
    scheduler = diffusers.DDIMScheduler(rescale_betas_zero_snr=True, prediction_type="v_prediction", clip_sample=False)
    assert scheduler.alphas_cumprod[-1] == 0
    scheduler.set_timesteps(1000)
    alpha_bar = sds.levels(scheduler.alphas_cumprod)[[999, 500]]
    v, z_t = torch.randn(2, 2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    noise = sds.noise_from_prediction(v, z_t, alpha_bar, "v_prediction")
    z_hat = sds.clean_estimate(z_t, noise, alpha_bar)
    torch.testing.assert_close(z_hat[0].float(), -v[0], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(noise[0].float(), z_t[0], rtol=1e-5, atol=1e-5)
    step = scheduler.step(v[1], 500, z_t[1])
    torch.testing.assert_close(z_hat[1].float(), step.pred_original_sample, rtol=1e-4, atol=1e-4)


def test_timesteps_fill_their_range_evenly() -> None:
    drawn = sds.draw_timesteps((0.02, 0.35), 1000, 20000, torch.Generator().manual_seed(0))
    assert drawn.dtype == torch.int64
    assert (drawn.min(), drawn.max()) == (20, 350)
    assert drawn.float().mean().item() == pytest.approx(185, abs=3)
    counts = torch.bincount((drawn - 20) // 83)[:4] / 20000
    assert counts.tolist() == pytest.approx([83 / 331] * 4, abs=0.015)


def test_each_timestep_of_a_narrow_range_is_as_likely_as_the_others() -> None:
    # Fractions .3 and .5 of the last timestep, 10; of no fraction at all, what is below the first goes to the first.
    generator = torch.Generator().manual_seed(0)
    drawn = sds.draw_timesteps((0.3, 0.5), 11, 30_000, generator)
    assert torch.bincount(drawn, minlength=6).tolist() == pytest.approx([0, 0, 0, 10_000, 10_000, 10_000], abs=400)
    first = sds.draw_timesteps((0.0, 1.0), 4, 30_000, generator)
    assert torch.bincount(first, minlength=4).tolist() == pytest.approx([0, 15_000, 7_500, 7_500], abs=400)


@pytest.mark.parametrize("annealing", ["linear", "sqrt"])
def test_a_schedule_runs_from_the_noisy_end_to_the_other(annealing: str) -> None:
    power = {"linear": 1, "sqrt": 0.5}[annealing]
    for progress in (0.0, 0.25, 0.5, 1.0):
        due = sds.scheduled_timesteps((0.1, 0.9), 1001, 3, annealing, progress)
        assert due.dtype == torch.int64 and due.tolist() == 3 * [round(900 - 800 * progress**power)]
    assert sds.scheduled_timesteps((0.0, 1.0), 50, 1, annealing, 1.0).tolist() == [1]
    assert sds.scheduled_timesteps((0.0, 1.0), 50, 1, annealing, 0.0).tolist() == [49]


def test_levels_keep_the_type_that_they_need() -> None:
    plain = torch.tensor([0.9, 0.5], dtype=torch.float64)
    assert sds.levels(plain).dtype == torch.float32 and sds.levels(plain).tolist() == pytest.approx([0.9, 0.5])
    ending = sds.levels(torch.tensor([0.9, 0.0]))
    assert ending.dtype == torch.float64 and 0 < ending[1] < 1e-9 and ending[0] == pytest.approx(0.9)


def test_the_perpendicular_part_of_each_sample() -> None:
    """Sample by sample: orthogonal to its own direction, and what is taken away is parallel to that."""
    generator = torch.Generator().manual_seed(7)
    other, direction = torch.randn(2, 2, 3, 4, 5, generator=generator, dtype=torch.float64)
    found = sds.perpendicular(other, direction)
    for sample in range(2):
        flat, along = (values[sample].flatten() for values in (other, direction))
        expected = flat - (flat @ along) / (along @ along) * along
        torch.testing.assert_close(found[sample].flatten(), expected)
    assert sds.perpendicular(other, torch.zeros_like(direction)).equal(other)


def test_timesteps_repeat_with_the_generator_and_stay_in_bounds() -> None:
    first, second = (sds.draw_timesteps((0.0, 1.0), 50, 500, torch.Generator().manual_seed(seed)) for seed in (5, 5))
    assert first.equal(second)
    assert first.min() >= 1 and first.max() == 49
    assert sds.draw_timesteps((0.5, 0.5), 1000, 3, torch.Generator().manual_seed(1)).unique().tolist() == [500]


def test_normalised_gradient_has_mean_size_one() -> None:
    assert sds.normalising_scale(latents(1.0, -3.0)) == 0.5
    assert math.isfinite(sds.normalising_scale(latents(0.0, 0.0)))
    two = torch.tensor([[[[1.0, -8.0]], [[3.0, 100.0]]]])
    assert sds.normalising_scale(two, torch.tensor([[[[1.0, 0.0]]]])) == 0.5
    assert sds.normalising_scale(two, torch.zeros(1, 1, 1, 2)) == 1


def test_carried_gradient_is_exact_however_small() -> None:
    """The detached-target form loses a gradient of 1e-9 beside latents of size 1; this one does not."""
    inputs = torch.ones(2, 4, requires_grad=True)
    gradient = torch.full((2, 4), 1e-9)
    loss = sds.carry_gradient(inputs, gradient, 3.5)
    assert loss.item() == 3.5
    (2 * loss).backward()
    assert inputs.grad.equal(2 * gradient)


def test_carried_gradient_agrees_with_the_detached_target() -> None:
    generator = torch.Generator().manual_seed(6)
    values, gradient = torch.randn(2, 3, 4, dtype=torch.float64, generator=generator)
    first, second = (values.clone().requires_grad_() for _ in range(2))
    (0.5 * (first - (first - gradient).detach()).square().sum()).backward()
    sds.carry_gradient(second, gradient, 0.0).backward()
    torch.testing.assert_close(first.grad, second.grad)
