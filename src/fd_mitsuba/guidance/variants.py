"""The variants of `guidance.variant`: how a diffusion model's noise becomes a gradient for clean latents.

An entry of `VARIANTS` each, with its own settings: `guidance.variant = {kind = "ism", interval = 0.1}`.

Symbols as in `sds`; g is the gradient with respect to z, z_hat the clean latents it pulls towards. e(text) is the noise
that the network sees with the prompt, e(free) that without: with the negative prompt, and for a network that sees the
base with the base's picture. e_hat is classifier-free guidance of the two (`sds.cfg_coefficients`).

The network itself, a `Network`, may predict e, v or z and take 4, 8 or 9 channels; no variant knows which.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol

import torch
from pydantic import Field
from torch import Tensor

from fd_mitsuba.config import Section
from fd_mitsuba.config.registry import Registry
from fd_mitsuba.conventions import Weighting
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.critic import Critic

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

    @abstractmethod
    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        """g with respect to z, and the clean latents z_hat to show; both (n, 4, L, L), on the network's device."""


VARIANTS: Registry[type[Variant]] = Registry("variants", "guidance variant")
"""Called with their settings."""


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


@dataclass(frozen=True)
class Area:
    """A place in the pictures with texts of its own.

    Attributes:
        mask: (n, 1, L, L) in [0, 1]; of all areas together at most 1.
        texts: pass -> (n, length, width), of the passes whose text differs from the chunk's.
    """

    mask: Tensor
    texts: dict[str, Tensor]

    def rows(self, rows: slice) -> Area:
        """The area in some of the pictures."""
        return Area(self.mask[rows], {name: text[rows] for name, text in self.texts.items()})


@dataclass(frozen=True)
class Chunk:
    """What the network needs for some pictures: all (n, ...), on its device, without gradients.

    `mask` (n, 1, L, L) of zeros and ones confines noise and gradient; None: they are everywhere. `areas` have texts of
    their own: there the network's noise is what it sees with these. `control` (n, 3, H, H) is for a ControlNet,
    `cameras` (n, 16) for a network that sees several views at once; its groups are consecutive and whole.
    """

    z: Tensor
    noise: Tensor
    timesteps: Tensor
    texts: dict[str, Tensor]
    condition: Tensor | None
    mask: Tensor | None
    areas: tuple[Area, ...] = ()
    control: Tensor | None = None
    cameras: Tensor | None = None


class Network(Protocol):
    """What the variants ask of `denoiser.Denoiser`."""

    @property
    def has_image_pass(self) -> bool: ...

    @property
    def alpha_bars(self) -> Tensor: ...

    def predict_noise(
        self,
        z_t: Tensor,
        timesteps: Tensor,
        texts: dict[str, Tensor],
        condition: Tensor | None,
        control: Tensor | None = None,
        cameras: Tensor | None = None,
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
        """Noise of each named pass: e + sum over areas of mask (e(area's text) - e)."""
        texts = {name: text for name, text in self.chunk.texts.items() if name in names}
        if missing := set(names) - set(texts):
            raise ValueError(f"{type(self.how.variant).__name__}: asks for {sorted(missing)}, not among its `passes`")
        known = self.chunk.condition, self.chunk.control, self.chunk.cameras
        seen = self.network.predict_noise(z_t, timesteps, texts, *known)
        merged = dict(seen)
        for area in self.chunk.areas:
            own = {name: area.texts[name] for name in texts if name in area.texts}
            if not own:
                continue
            for name, noise in self.network.predict_noise(z_t, timesteps, own, *known).items():
                merged[name] = merged[name] + area.mask * (noise - seen[name])
        return merged

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


@VARIANTS.register("sds")
class ScoreDistillation(Variant):
    """g = w(t) (e_hat(z_t) - e): SDS (DreamFusion, arXiv 2209.14988; the paper's section "Preliminary")."""

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        timesteps = query.chunk.timesteps
        z_t = query.noised(timesteps)
        noise_hat = query.guided(z_t, timesteps)
        preview = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(timesteps))
        return sds.sds_gradient(noise_hat, query.noise, query.weights()), preview


@VARIANTS.register("csd")
class ClassifierScore(Variant):
    """g = w(t) (e(text; z_t) - e(free; z_t)): CSD (arXiv 2310.19415). The guidance scale plays no part in it."""

    passes = ("text", "free")

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        timesteps = query.chunk.timesteps
        z_t = query.noised(timesteps)
        seen = query.passes(z_t, timesteps, ("text", query.free))
        preview = sds.clean_estimate(z_t, seen["text"], query.alpha_bar(timesteps))
        return sds.csd_gradient(seen["text"], seen[query.free], query.weights()), preview


class IntervalSettings(Section):
    """Of `ism`."""

    interval: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Distance between the two noise levels that are compared, as a share of all timesteps."""
    inversion_step: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Stride of the DDIM inversion up to the lower of them; each stride is one pass of the network."""


@VARIANTS.register("ism", IntervalSettings)
class IntervalScore(Variant):
    """g = w(t) (e_hat(z_t) - e(free; z_s)): ISM (LucidDreamer, arXiv 2311.11284).

    s = t - delta_T. z_s is z carried from timestep 0 to s by DDIM inversion in steps of delta_S, z_t is z_s carried one
    step further, both by e(free): the drawn noise enters at timestep 0 only, where there is next to none. A picture
    whose s is reached waits for its neighbours, and its result does not depend on them.
    """

    passes = ("guided", "free")
    settings: IntervalSettings

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        last, own = len(query.network.alpha_bars) - 1, self.settings
        interval, stride = (max(1, round(share * last)) for share in (own.interval, own.inversion_step))
        end = query.chunk.timesteps
        start = (end - interval).clamp(min=0)
        now = torch.zeros_like(end)
        z_s = query.noised(now)
        for _ in range(-(-int(start.max()) // stride)):
            following = torch.minimum(now + stride, start)
            moved = query.move(z_s, query.passes(z_s, now, (query.free,))[query.free], now, following)
            z_s = torch.where((following > now).view(-1, 1, 1, 1), moved, z_s)
            now = following
        noise_start = query.passes(z_s, start, (query.free,))[query.free]
        z_t = query.move(z_s, noise_start, start, end)
        noise_hat = query.guided(z_t, end)
        preview = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(end))
        return sds.sds_gradient(noise_hat, noise_start, query.weights()), preview


class ReconstructionSettings(Section):
    """Of `reconstruction`."""

    steps: Annotated[int, Field(ge=1, le=50)] = 4
    """DDIM steps from z_t to the clean latents."""


@VARIANTS.register("reconstruction", ReconstructionSettings)
class Reconstruction(Variant):
    """g = w(t) (z - z_hat), z_hat after DDIM steps from z_t by e_hat (HiFA, arXiv 2305.18766).

    With many steps z_hat is the edited picture of an iterative dataset update (Instruct-NeRF2NeRF, arXiv 2303.12789).
    The steps are evenly spaced from t to the clean latents.
    """

    settings: ReconstructionSettings

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        now, steps = query.chunk.timesteps, self.settings.steps
        z_t = query.noised(now)
        noise_hat = query.guided(z_t, now)
        for remaining in range(steps - 1, 0, -1):
            following = query.chunk.timesteps * remaining // steps
            z_t = query.move(z_t, noise_hat, now, following)
            now = following
            noise_hat = query.guided(z_t, now)
        z_hat = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(now))
        return sds.reconstruction_gradient(query.chunk.z, z_hat, query.weights()), z_hat


class VariationalSettings(Section):
    """Of `vsd`."""

    rank: Annotated[int, Field(ge=1, le=64)] = 4
    """Of the critic's change of each matrix."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 1e-4
    """Of the critic."""


@VARIANTS.register("vsd", VariationalSettings)
class VariationalScore(Variant):
    """g = w(t) (e_hat(z_t) - e_critic(z_t)): VSD (ProlificDreamer, arXiv 2305.16213).

    e_critic is the network with a LoRA that learns, one step after each, to see the noise in the step's own latents at
    timesteps from the whole range. It reads the prompt, with the word for the view, where ProlificDreamer tells it the
    camera; it starts anew in each phase.
    """

    passes = ("guided", "text")
    learns = True
    settings: VariationalSettings

    def gradient(self, query: Query) -> tuple[Tensor, Tensor]:
        timesteps = query.chunk.timesteps
        z_t = query.noised(timesteps)
        noise_hat = query.guided(z_t, timesteps)
        preview = sds.clean_estimate(z_t, noise_hat, query.alpha_bar(timesteps))
        return sds.sds_gradient(noise_hat, query.criticised(z_t, timesteps), query.weights()), preview


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


def passes_of(how: Distillation, has_image_pass: bool) -> tuple[str, ...]:
    """Names of all passes that the variant asks for; a pass without weight is left out."""
    free = (free_pass(has_image_pass),)
    names = {"guided": _guided_passes(how, has_image_pass), "text": ("text",), "free": free}
    return tuple(dict.fromkeys(name for asked in how.variant.passes for name in names[asked]))
