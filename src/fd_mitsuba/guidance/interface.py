"""What the training stages know of a guidance: pictures in, out a loss whose gradient says "more like the text"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
import torch

from fd_mitsuba.conventions import GEOMETRY_CHANNELS, NormalSpace
from fd_mitsuba.errors import RunStopped

Phase = Literal["coarse", "refined", "appearance"]
"""What the pictures of a step are: normals at the size of the latents, normals at full size, colours."""

Angles = Sequence[float] | np.ndarray
"""One for each view, degrees."""


class NonFiniteGuidance(RunStopped):
    """The guidance gradient has a NaN or an infinity; the message names the timesteps. The run cannot go on from it."""


@dataclass(frozen=True)
class GuidanceViews:
    """Rendered views of one step, all with the same camera set.

    Attributes:
        pictures: geometry pictures (B, 5, H, W) of the edited object, channels as `conventions.GEOMETRY_CHANNELS`:
            normal times coverage in [-1, 1], then coverages in [0, 1]. Gradients flow to them.
        base: geometry pictures (B, 5, H, W) of the unedited base from the same cameras, or None. No gradients.
        azimuth_deg: B azimuths. A model that sees a mosaic takes consecutive views as one mosaic.
        elevation_deg: B elevations.
        closeup: whether the cameras are centred on the focal regions and close.
        regions: part -> (B, 1, R, R), the share of each pixel in which one of its focal regions comes first; given to
            a guidance that has a `region_size`, which is R.
        share: which of the step's views these are, where several processes share them; None: they are all.
        drafted: whether the part follows what a `Drafter` has drawn, so that noise need not decide what it is to be.
    """

    pictures: torch.Tensor
    base: torch.Tensor | None
    azimuth_deg: Angles
    elevation_deg: Angles
    closeup: bool = False
    regions: Mapping[str, torch.Tensor] = field(default_factory=dict)
    share: slice | None = None
    drafted: bool = False

    def __post_init__(self) -> None:
        shape = tuple(self.pictures.shape)
        if len(shape) != 4 or shape[1] != len(GEOMETRY_CHANNELS) or shape[2] != shape[3]:
            raise ValueError(f"pictures must be (B, {len(GEOMETRY_CHANNELS)}, H, H), not {shape}")
        if self.base is not None and tuple(self.base.shape) != shape:
            raise ValueError(f"base pictures {tuple(self.base.shape)} must have the shape of the pictures, {shape}")
        if not len(self.azimuth_deg) == len(self.elevation_deg) == shape[0]:
            raise ValueError(f"{shape[0]} pictures need as many azimuths and elevations")


@dataclass(frozen=True)
class AppearanceViews:
    """Colour pictures of one step; height and width are the same for all, and square.

    Attributes:
        pictures: (B, 3, H, H) sRGB in [0, 1] of the edited object over the caller's background. Gradients flow to them.
        condition: the same views with the part in plain grey clay, for a model that sees what it edits, or None.
        mask: (B, 1, H, H) the object's coverage in [0, 1].
        part_mask: (B, 1, H, H) the part's coverage in [0, 1].
        shine: (B, 1, H, H) `colour_latents.shine` of the part times its coverage, for models that look at it. Gradients
            flow to it.
        azimuth_deg, elevation_deg, closeup, regions, share: as in `GuidanceViews`.
        control: (B, 3, H, H) in [0, 1] what a ControlNet is shown of the surface, for a guidance with `control_sees`.
    """

    pictures: torch.Tensor
    condition: torch.Tensor | None
    mask: torch.Tensor
    part_mask: torch.Tensor
    shine: torch.Tensor
    azimuth_deg: Angles
    elevation_deg: Angles
    closeup: bool = False
    regions: Mapping[str, torch.Tensor] = field(default_factory=dict)
    share: slice | None = None
    control: torch.Tensor | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.pictures.shape)
        if len(shape) != 4 or shape[1] != 3 or shape[2] != shape[3]:
            raise ValueError(f"pictures must be (B, 3, H, H), not {shape}")
        for name in ("condition", "control"):
            given = getattr(self, name)
            if given is not None and tuple(given.shape) != shape:
                raise ValueError(f"the {name} {tuple(given.shape)} must have the shape of the pictures, {shape}")
        for name in ("mask", "part_mask", "shine"):
            if tuple(getattr(self, name).shape) != (shape[0], 1, *shape[2:]):
                raise ValueError(f"{name} must be {(shape[0], 1, *shape[2:])}, not {tuple(getattr(self, name).shape)}")
        if not len(self.azimuth_deg) == len(self.elevation_deg) == shape[0]:
            raise ValueError(f"{shape[0]} pictures need as many azimuths and elevations")


@dataclass(frozen=True)
class GuidanceResult:
    """Attributes:
    loss: scalar; its gradient with respect to the pictures is the guidance gradient, its value only a size to log.
    logs: numbers for the metrics file.
    preview: the model's estimate (N, 4, L, L) of the clean latents, one per picture or mosaic; no gradients.
    """

    loss: torch.Tensor
    logs: dict[str, float] = field(default_factory=dict)
    preview: torch.Tensor | None = None


@dataclass(frozen=True)
class Drawn:
    """Attributes:
    latents: (N, 4, L, L) clean latents of pictures or mosaics of the edited object.
    part: (B, H, H) how surely each pixel of the views is something else than the base, in [0, 1].
    change: how much is another thing than the base, as a mean over the latents in [0, 1].
    """

    latents: torch.Tensor
    part: torch.Tensor
    change: float


class Drafter(Protocol):
    """Draws the edited object, and leads to what was drawn. `drafter.DiffusionDrafter` is the one the package ships."""

    def draw(self, views: GuidanceViews, seed: int) -> Drawn:
        """Pictures of the edited object for views of the base."""
        ...

    def guide(self, pictures: torch.Tensor, drawn: Drawn, chosen: slice) -> GuidanceResult:
        """The loss of pictures (B, 5, H, H) of the coarse phase: how far they are from the `chosen` latents."""
        ...


class Guidance(Protocol):
    """A source of guidance. `DiffusionGuidance` is the one the package ships.

    Optional, for scenes whose focal regions have prompts: `set_part_prompts(prompts)` takes part -> (prompt, negative
    prompt), and `region_size` is the side in pixels at which `GuidanceViews.regions` must be given, or None.
    Optional, for models that see several views at once: `views_together`, of which the number of views must be a
    multiple. They are consecutive, share elevation and distance, and are evenly spread around the object.
    Optional, for models that draw the edited object at once: `drafter`, a `Drafter` or None, for the coarse phase.
    Optional, for what learns from step to step: `learned_state()`, tensors by name, which checkpoints hold, and
    `load_learned_state(tensors)`, ValueError where they do not fit.

    Properties here may be plain attributes of a class: nothing writes to them.
    """

    @property
    def needs_base(self) -> bool:
        """Whether `GuidanceViews.base` must be given."""
        ...

    @property
    def view_grid(self) -> int:
        """Pictures are mosaics of view_grid x view_grid views; the number of views must be a multiple of its square.

        The views of a mosaic are consecutive, and view i looks from azimuth_deg[0] + 360 i / view_grid^2.
        """
        ...

    @property
    def normal_space(self) -> NormalSpace | None:
        """Frame of the normals that the model was trained with; None: either will do."""
        ...

    def picture_size(self, phase: Phase) -> int:
        """Height and width in pixels at which the views of a phase must be rendered."""
        ...

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """Take the text to pull towards and the one to push away from; must be called before `guide`.

        Returns the words that the model cannot know, which the user should be told.
        """
        ...

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: Phase, seed: int) -> GuidanceResult:
        """The loss of one step; `step` counts from 0 within the phase, `steps_total` is the phase's length."""
        ...


class AppearanceGuidance(Protocol):
    """A source of guidance for the appearance stage.

    Optional, beside what `Guidance` names: `control_sees`, `depth` or `normal`, asks for `AppearanceViews.control`.
    """

    @property
    def needs_base(self) -> bool:
        """Whether `AppearanceViews.condition` must be given."""
        ...

    @property
    def view_grid(self) -> int:
        """As `Guidance.view_grid`."""
        ...

    @property
    def appearance_size(self) -> int:
        """Height and width in pixels that suit the model best; other sizes are resized."""
        ...

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """As `Guidance.set_prompt`."""
        ...

    def guide_appearance(self, views: AppearanceViews, step: int, steps_total: int, seed: int) -> GuidanceResult:
        """The loss of one step; `step` counts from 0 within the stage."""
        ...
