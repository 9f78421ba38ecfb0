"""Score distillation as plain tensor functions: no model, no prompt, no state.

Symbols: z clean latents, e noise, t timestep, `alpha_bar` the scheduler's cumulative product of alphas at t, so that
    z_t = sqrt(alpha_bar) z + sqrt(1 - alpha_bar) e.
Latents are (N, C, H, W); everything per timestep is (N,) and is broadcast here.
"""

from __future__ import annotations

from typing import Literal, assert_never

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from fd_mitsuba.conventions import Weighting

PredictionType = Literal["epsilon", "v_prediction", "sample"]
Annealing = Literal["linear", "sqrt"]
_LEAST_LEVEL = 1e-12

Latents = Float[Tensor, "N C H W"]
PerLatent = Float[Tensor, " N"]


def _per_latent(values: PerLatent) -> Float[Tensor, "N 1 1 1"]:
    return values.view(-1, 1, 1, 1)


def weight(weighting: Weighting, alpha_bar: PerLatent) -> PerLatent:
    """w(t), which the paper leaves open, for each alpha_bar.

    `sds`: 1 - alpha_bar (DreamFusion); `uniform`: 1; `fantasia3d`: sqrt(alpha_bar) (1 - alpha_bar);
    `inverse`: 1 / (1 - alpha_bar); `ism`: sqrt((1 - alpha_bar) / alpha_bar) (LucidDreamer, arXiv 2311.11284).
    """
    if weighting == "sds":
        return 1 - alpha_bar
    if weighting == "uniform":
        return torch.ones_like(alpha_bar)
    if weighting == "fantasia3d":
        return alpha_bar.sqrt() * (1 - alpha_bar)
    if weighting == "inverse":
        return 1 / (1 - alpha_bar)
    if weighting == "ism":
        return ((1 - alpha_bar) / alpha_bar).sqrt()
    assert_never(weighting)


def draw_timesteps(
    bounds: tuple[float, float], train_timesteps: int, count: int, generator: torch.Generator
) -> Int64[Tensor, " N"]:
    """`count` timesteps (int64, CPU), t ~ U[t_0, t_final] (paper, supplement "Score Distillation Sampling Settings").

    `bounds` are fractions of the scheduler's training timesteps; the draw is kept inside [1, train_timesteps - 1].
    """
    low, high = (round(bound * (train_timesteps - 1)) for bound in bounds)
    draw = torch.rand(count, generator=generator, dtype=torch.float64)
    timesteps = (low + draw * (high - low + 1)).floor().long().clamp(max=high)
    return timesteps.clamp(min=1)


def scheduled_timesteps(
    bounds: tuple[float, float], train_timesteps: int, count: int, annealing: Annealing, progress: float
) -> Int64[Tensor, " N"]:
    """`count` times the one timestep (int64, CPU) that is due at `progress` in [0, 1]; nothing is random.

        linear: t = high - (high - low) progress           (DreamTime, arXiv 2306.12422, with an even weight)
        sqrt:   t = high - (high - low) sqrt(progress)     (HiFA, arXiv 2305.18766)

    `bounds` and limits as in `draw_timesteps`.
    """
    low, high = (bound * (train_timesteps - 1) for bound in bounds)
    share = progress if annealing == "linear" else progress**0.5
    due = round(high - (high - low) * share)
    return torch.full((count,), max(due, 1))


def add_noise(z: Latents, noise: Latents, alpha_bar: PerLatent) -> Latents:
    """z_t = sqrt(alpha_bar) z + sqrt(1 - alpha_bar) e (DDPM's forward process)."""
    abar = _per_latent(alpha_bar)
    return abar.sqrt() * z + (1 - abar).sqrt() * noise


def noise_from_prediction(prediction: Latents, z_t: Latents, alpha_bar: PerLatent, kind: PredictionType) -> Latents:
    """The noise e_hat that a network's output stands for.

    v = sqrt(alpha_bar) e - sqrt(1 - alpha_bar) z  gives  e = sqrt(alpha_bar) v + sqrt(1 - alpha_bar) z_t
    (progressive distillation); `sample` is a prediction of z itself.
    """
    abar = _per_latent(alpha_bar)
    if kind == "epsilon":
        return prediction
    if kind == "v_prediction":
        return abar.sqrt() * prediction + (1 - abar).sqrt() * z_t
    if kind == "sample":
        return (z_t - abar.sqrt() * prediction) / (1 - abar).sqrt()
    assert_never(kind)


def clean_estimate(z_t: Latents, noise_hat: Latents, alpha_bar: PerLatent) -> Latents:
    """z_hat = (z_t - sqrt(1 - alpha_bar) e_hat) / sqrt(alpha_bar): the clean latents that e_hat implies.

    Near alpha_bar = 0 this is the difference of two numbers that are nearly the same: see `levels`.
    """
    abar = _per_latent(alpha_bar)
    return (z_t - (1 - abar).sqrt() * noise_hat) / abar.sqrt().clamp(min=_LEAST_LEVEL**0.5)


def levels(alphas_cumprod: Tensor) -> Tensor:
    """alpha_bar of all timesteps as the formulas here take them: float32, and float64 where one is 0.

    A schedule with zero terminal SNR (arXiv 2305.08891) has alpha_bar = 0 at its last timestep, where e_hat = z_t says
    nothing of what the network sees. With 1e-12 in its place and 16 digits, `noise_from_prediction` of v and
    `clean_estimate` give z_hat = -v there, to a millionth.
    """
    if bool((alphas_cumprod > 0).all()):
        return alphas_cumprod.to(torch.float32)
    return alphas_cumprod.to(torch.float64).clamp(min=_LEAST_LEVEL)


def cfg_coefficients(scale: float) -> dict[str, float]:
    """Classifier-free guidance as a sum over passes of the network: e_hat = sum of coefficient * e(pass).

        e_hat = e(plain) + scale (e(text) - e(plain))

    `plain` reads the negative prompt. This is diffusers' writing; DreamFusion's text + s (text - plain) has
    scale = s + 1. A pass whose coefficient is 0 is left out, so that scale = 1 costs one pass.
    """
    return _nonzero({"text": scale, "plain": 1 - scale})


def cfg_coefficients_with_image(text_scale: float, image_scale: float) -> dict[str, float]:
    """The same with a text and an image as conditions (InstructPix2Pix, equation 3).

        e_hat = e(plain) + image_scale (e(image) - e(plain)) + text_scale (e(text) - e(image))

    `text` sees image and text, `image` the image and the negative prompt, `plain` a zero image and the negative prompt.
    """
    return _nonzero({"text": text_scale, "image": image_scale - text_scale, "plain": 1 - image_scale})


def _nonzero(coefficients: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in coefficients.items() if value != 0}


def combine(predictions: dict[str, Tensor], coefficients: dict[str, float]) -> Latents:
    """Sum of coefficient times prediction over the passes that `coefficients` names."""
    return sum(value * predictions[name] for name, value in coefficients.items())  # type: ignore[return-value]


def perpendicular(other: Latents, direction: Latents) -> Latents:
    """What of `other` (N, C, H, W) is perpendicular to `direction`, sample by sample: o - (o d / d d) d (Perp-Neg)."""
    inner = (other * direction).sum(dim=(1, 2, 3), keepdim=True)
    square = direction.square().sum(dim=(1, 2, 3), keepdim=True)
    return other - inner / square.clamp(min=torch.finfo(direction.dtype).tiny) * direction


def sds_gradient(noise_hat: Latents, noise: Latents, weights: PerLatent) -> Latents:
    """w(t) (e_hat - e), with respect to z (paper, section "Preliminary", the SDS equation)."""
    return _per_latent(weights) * (noise_hat - noise)


def csd_gradient(noise_text: Latents, noise_plain: Latents, weights: PerLatent) -> Latents:
    """w(t) (e(text) - e(plain)): only the part of the score that the text explains (classifier score distillation)."""
    return _per_latent(weights) * (noise_text - noise_plain)


def reconstruction_gradient(z: Latents, z_hat: Latents, weights: PerLatent) -> Latents:
    """w(t) (z - z_hat): towards the denoised latents (the gradient of w/2 |z - z_hat|^2 with z_hat held fixed).

    With z_hat from one denoising step this is SDS with its weight times sqrt((1 - alpha_bar) / alpha_bar).
    """
    return _per_latent(weights) * (z - z_hat)


def ddim_step(z_t: Latents, noise_hat: Latents, alpha_bar: PerLatent, alpha_bar_next: PerLatent) -> Latents:
    """Latents at the next, less noisy level: add_noise(z_hat, e_hat, alpha_bar_next) (DDIM with eta 0)."""
    return add_noise(clean_estimate(z_t, noise_hat, alpha_bar), noise_hat, alpha_bar_next)


def normalising_scale(gradient: Latents, mask: Float[Tensor, "N 1 H W"] | None = None) -> float:
    """1 / mean |g|: a gradient times this has mean size 1, so that step sizes do not depend on t.

    With a mask (N, 1, L, L) of zeros and ones the mean is over its ones; a mask without any gives 1.
    """
    size = gradient.abs()
    if mask is not None:
        size = size[mask.expand_as(size) > 0]
        if not size.numel():
            return 1.0
    return 1 / max(float(size.mean()), torch.finfo(gradient.dtype).tiny)


def carry_gradient(
    inputs: Float[Tensor, "*shape"], gradient: Float[Tensor, "*shape"], value: float
) -> Float[Tensor, ""]:
    """A scalar with the given value whose gradient with respect to `inputs` is exactly `gradient`.

    The same as 0.5 |x - (x - g).detach()|^2, without the rounding of x - (x - g) where g is small beside x.
    """
    inner = (inputs * gradient.detach()).sum()
    return inner - inner.detach() + value
