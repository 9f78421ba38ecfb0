"""Networks that are perfect for normally distributed data, against which guidance can be checked in closed form.

For z ~ N(m, sigma^2) the noisy latents are normal too, with variance v = alpha sigma^2 + 1 - alpha, so that the noise
that a perfect network sees is e(z_t) = sqrt(1 - alpha) (z_t - sqrt(alpha) m) / v, and the paths of DDIM with endless
many steps keep (z_t - sqrt(alpha) m) / sqrt(v).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import torch
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.guidance.chunk import Beside, Chunk
from fd_mitsuba.guidance.denoiser import Denoiser
from fd_mitsuba.guidance.loading import Components
from fd_mitsuba.guidance.model_conventions import ModelConventions
from fd_mitsuba.guidance.query import Distillation
from fd_mitsuba.guidance.variants import VARIANTS

SIGMA = 0.5
TEXT, FREE = 0.8, -0.3
"""Mean of the data with and without the prompt; with 8 channels the base's latents are added to both."""
ALPHA_BARS = torch.linspace(0.9999**0.5, 0.07, 1000, dtype=torch.float64) ** 2


class Settings(dict):
    """A component's config as diffusers has it: a mapping whose keys are attributes too."""

    __getattr__ = dict.__getitem__


class NormalData(torch.nn.Module):
    """A UNet that is perfect for normal data; the first number of the text states is the mean."""

    dtype = torch.float64

    def __init__(self, kind: str, channels: int) -> None:
        super().__init__()
        self.kind, self.config = kind, Settings(in_channels=channels, sample_size=4)
        self.seen: list[Tensor] = []

    def forward(self, inputs: Tensor, t: Tensor, encoder_hidden_states: Tensor, return_dict: bool) -> tuple[Tensor]:
        z_t, alpha = inputs[:, :4].double(), ALPHA_BARS[t].view(-1, 1, 1, 1)
        self.seen.append(z_t)
        mean = encoder_hidden_states[:, 0, 0].double().view(-1, 1, 1, 1) + inputs[:, 4:].sum(1, keepdim=True)
        noise = noise_seen(z_t, alpha, mean)
        z = (z_t - (1 - alpha).sqrt() * noise) / alpha.sqrt()
        v = alpha.sqrt() * noise - (1 - alpha).sqrt() * z
        return (ExactDouble({"epsilon": noise, "v_prediction": v, "sample": z}[self.kind]),)


class ExactDouble(torch.Tensor):
    """A double tensor that stays one when the denoiser asks for single precision, so that closed forms can be exact."""

    @staticmethod
    def __new__(cls, values: Tensor) -> ExactDouble:
        return values.as_subclass(cls)

    def float(self) -> Tensor:  # type: ignore[override]
        return self.as_subclass(torch.Tensor)


def noise_seen(z_t: Tensor, alpha: Tensor, mean: Tensor | float) -> Tensor:
    return (1 - alpha).sqrt() * (z_t - alpha.sqrt() * mean) / (alpha * SIGMA**2 + 1 - alpha)


def along_the_path(z: Tensor, mean: float, start: Tensor, end: Tensor) -> Tensor:
    """Where endless many DDIM steps lead from level `start` to level `end`."""
    spread = [(alpha * SIGMA**2 + 1 - alpha).sqrt() for alpha in (start, end)]
    return end.sqrt() * mean + spread[1] * (z - start.sqrt() * mean) / spread[0]


def denoiser(kind: str = "epsilon", channels: int = 4) -> Denoiser:
    scheduler = SimpleNamespace(alphas_cumprod=ALPHA_BARS, config={"prediction_type": kind})
    parts = Components(None, None, NormalData(kind, channels), None, scheduler, ModelConventions(), Path("normal"))
    made = Denoiser(parts, GuidanceConfig(views_per_call=8))
    made.alpha_bars = ALPHA_BARS
    return made


def how(variant: str, own: dict | None = None, **changes: object) -> Distillation:
    made = VARIANTS.make(Choice.of(variant, own), "guidance.variant")
    return replace(Distillation(made, "uniform", 1.0, 1.0, (0.0, 1.0)), **changes)


def chunk(*timesteps: int, mask: Tensor | None = None, base: float | None = None, seed: int = 0) -> Chunk:
    count = len(timesteps)
    generator = torch.Generator().manual_seed(seed)
    z, noise = torch.randn(2, count, 4, 4, 4, generator=generator, dtype=torch.float64)
    states = {"text": TEXT, "image": FREE, "plain": FREE}
    texts = {name: torch.full((count, 2, 3), value, dtype=torch.float64) for name, value in states.items()}
    condition = None if base is None else torch.full((count, 4, 4, 4), base / 4, dtype=torch.float64)
    return Chunk(z, noise, torch.tensor(timesteps), texts, Beside(condition), mask)


def level(*timesteps: int) -> Tensor:
    return ALPHA_BARS[list(timesteps)].view(-1, 1, 1, 1)
