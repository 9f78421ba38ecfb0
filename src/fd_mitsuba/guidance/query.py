"""What a variant of `guidance.variant` is told, and what it may ask of the network.

e(text) is the noise that the network sees with the prompt, e(free) that without: with the negative prompt, and for a
network that sees the base with the base's picture. e_hat is classifier-free guidance of the two
(`sds.cfg_coefficients`). The network itself, a `Network`, may predict e, v or z and take 4, 8 or 9 channels; no variant
knows which.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import torch
from torch import Tensor

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.conventions import Weighting
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import NOTHING, Area, Beside, Chunk
from fd_mitsuba.guidance.critic import Critic
from fd_mitsuba.guidance.interface import Phase

Pass = Literal["guided", "text", "free"]


class Variant(ABC):
    """Makes a gradient for clean latents of what the network sees.

    Attributes:
        passes: the network's passes that `gradient` asks for: `guided` (those of classifier-free guidance), `text`,
            `free` (that without the prompt).
        learns: there is a `Query.critic`, which learns what the latents are like.
        settings: its own, as the registry has checked them.
    """

    passes: ClassVar[tuple[Pass, ...]] = ("guided",)
    learns: ClassVar[bool] = False

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    def asked(self, timestep_range: tuple[float, float], together: int) -> dict[Pass, float]:
        """How often each kind of pass is run for a picture in a step, on average; for the forecast of a run's time.

        A pass backward counts as one more: the network's weights are constant, so that it costs as much as one forward.

        Args:
            timestep_range: from which timesteps are drawn, as shares of all.
            together: pictures that are worked on at once and wait for each other.
        """
        return dict.fromkeys(self.passes, 1.0)

    @abstractmethod
    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        """g with respect to z, and the clean latents z_hat to show; both (n, 4, L, L), on the network's device."""


@dataclass(frozen=True)
class Distillation:
    """How the gradient is made in one phase; the names are those of the settings."""

    variant: Variant
    weighting: Weighting
    guidance_scale: float
    image_guidance_scale: float
    timestep_range: tuple[float, float]
    perp_neg: float = 0.0
    critic: Critic | None = None
    """For a variant that `learns`."""

    @classmethod
    def of_phase(
        cls,
        phase: Phase,
        config: GuidanceConfig,
        appearance: AppearanceConfig,
        variant: Variant,
        critic: Critic | None = None,
    ) -> Distillation:
        """As the settings have it."""
        settings = appearance if phase == "appearance" else config
        return cls(
            variant,
            settings.weighting,
            settings.guidance_scale,
            settings.image_guidance_scale,
            timestep_range(config, appearance, phase),
            config.perp_neg,
            critic,
        )


def timestep_range(
    config: GuidanceConfig, appearance: AppearanceConfig, phase: Phase, drafted: bool = False
) -> tuple[float, float]:
    """Between which shares of the model's timesteps a phase is guided.

    Args:
        drafted: see `GuidanceViews`; the coarse phase has a range of its own then.
    """
    if drafted and phase == "coarse":
        return config.timestep_range_drafted
    ranges = {
        "coarse": config.timestep_range_coarse,
        "refined": config.timestep_range_refined,
        "appearance": appearance.timestep_range,
    }
    return ranges[phase]


class Network(Protocol):
    """What the variants ask of `denoiser.Denoiser`."""

    @property
    def has_image_pass(self) -> bool: ...

    @property
    def sees_region(self) -> bool: ...

    @property
    def alpha_bars(self) -> Tensor: ...

    def predict_noise(
        self, z_t: Tensor, timesteps: Tensor, texts: dict[str, Tensor], beside: Beside = NOTHING
    ) -> dict[str, Tensor]: ...


@dataclass(frozen=True)
class Query:
    """One chunk before one network: what the variants are written with."""

    network: Network
    chunk: Chunk
    how: Distillation

    @property
    def free(self) -> str:
        return free_pass(self.network.has_image_pass)

    @property
    def noise(self) -> Tensor:
        """The drawn noise, where the mask lets it."""
        return self.chunk.noise if self.chunk.mask is None else self.chunk.noise * self.chunk.mask

    def alpha_bar(self, timesteps: Tensor) -> Tensor:
        return self.network.alpha_bars[timesteps]

    def weights(self) -> Tensor:
        """w(t) at the drawn timesteps."""
        return sds.weight(self.how.weighting, self.alpha_bar(self.chunk.timesteps))

    def noised(self, timesteps: Tensor) -> Tensor:
        """z with the drawn noise at these levels."""
        return sds.add_noise(self.chunk.z, self.noise, self.alpha_bar(timesteps))

    def passes(self, z_t: Tensor, timesteps: Tensor, names: Collection[str]) -> dict[str, Tensor]:
        """Noise of each named pass: e + sum over areas of mask (e(area's text) - e).

        A network that is told where the part may be is told of that area alone with its text. Where an area is all
        there is, nothing else is asked.
        """
        texts = {name: text for name, text in self.chunk.texts.items() if name in names}
        if missing := set(names) - set(texts):
            raise ValueError(f"{type(self.how.variant).__name__}: asks for {sorted(missing)}, not among its `passes`")
        beside = self.chunk.beside
        for area in self.chunk.areas:
            if bool((area.mask == 1).all()):
                own = {name: area.texts.get(name, text) for name, text in texts.items()}
                return self.network.predict_noise(z_t, timesteps, own, self._beside(area))
        seen = self.network.predict_noise(z_t, timesteps, texts, beside)
        merged = dict(seen)
        for area in self.chunk.areas:
            own = {name: area.texts[name] for name in texts if name in area.texts}
            if not own:
                continue
            for name, noise in self.network.predict_noise(z_t, timesteps, own, self._beside(area)).items():
                merged[name] = merged[name] + area.mask * (noise - seen[name])
        return merged

    def _beside(self, area: Area) -> Beside:
        return self.chunk.beside.told(area.mask) if self.network.sees_region else self.chunk.beside

    def guided(self, z_t: Tensor, timesteps: Tensor) -> Tensor:
        """e_hat: classifier-free guidance; with `perp_neg` less scale perp_neg perp(e(negative) - e(free)).

        perp: what is perpendicular to e(text) - e(free), which read no negative prompt then (arXiv 2304.04968).
        """
        how, with_image = self.how, self.network.has_image_pass
        coefficients = guidance_coefficients(how, with_image)
        seen = self.passes(z_t, timesteps, _guided_passes(how, with_image))
        noise_hat = sds.combine(seen, coefficients)
        if how.perp_neg == 0:
            return noise_hat
        free = seen[self.free]
        away = sds.perpendicular(seen["negative"] - free, seen["text"] - free)
        return noise_hat - how.guidance_scale * how.perp_neg * away

    def criticised(self, z_t: Tensor, timesteps: Tensor) -> Tensor:
        """The noise that the critic sees with the prompt."""
        assert self.how.critic is not None
        with self.how.critic.acting():
            return self.passes(z_t, timesteps, ("text",))["text"]

    def move(self, z_t: Tensor, noise_hat: Tensor, now: Tensor, to: Tensor) -> Tensor:
        """A DDIM step to the levels `to`, up or down. Outside the mask z stays what it is, without noise."""
        moved = sds.ddim_step(z_t, noise_hat, self.alpha_bar(now), self.alpha_bar(to))
        if self.chunk.mask is None:
            return moved
        outside = sds.add_noise(self.chunk.z, torch.zeros_like(moved), self.alpha_bar(to))
        return torch.where(self.chunk.mask > 0, moved, outside)


def free_pass(has_image_pass: bool) -> str:
    """Name of the pass without the prompt: a network that is guided by the base's image, too, still sees it there."""
    return "image" if has_image_pass else "plain"


def guidance_coefficients(how: Distillation, has_image_pass: bool) -> dict[str, float]:
    """The passes of classifier-free guidance with their coefficients."""
    if has_image_pass:
        return sds.cfg_coefficients_with_image(how.guidance_scale, how.image_guidance_scale)
    return sds.cfg_coefficients(how.guidance_scale)


def _guided_passes(how: Distillation, has_image_pass: bool) -> tuple[str, ...]:
    """Names of the passes that `Query.guided` asks for."""
    names = tuple(guidance_coefficients(how, has_image_pass))
    if how.perp_neg == 0:
        return names
    return tuple(dict.fromkeys((*names, "text", "negative", free_pass(has_image_pass))))


def pass_names(how: Distillation, has_image_pass: bool) -> dict[Pass, tuple[str, ...]]:
    """Names of the network's passes behind each kind; a pass without weight is left out."""
    return {
        "guided": _guided_passes(how, has_image_pass),
        "text": ("text",),
        "free": (free_pass(has_image_pass),),
    }


def passes_of(how: Distillation, has_image_pass: bool) -> tuple[str, ...]:
    """Names of all passes that the variant asks for."""
    names = pass_names(how, has_image_pass)
    return tuple(dict.fromkeys(name for asked in how.variant.passes for name in names[asked]))
